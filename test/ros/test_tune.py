"""`tactile tune` in a terminal beside real nodes: taken, refused, undone, changed by others, recorded."""

import contextlib
import fcntl
import os
import pty
import signal
import struct
import subprocess
import sys
import termios

import pytest
from rcl_interfaces.msg import ParameterEvent

from tactile_control.task_file import load_task, task_path
from tactile_records.bags.reader import read_bag
from tactile_view.cell_state import CellState
from tactile_view.recording import Recording

CONTROLLER, FILTER = "tactile_ros.nodes.controller_node", "tactile_ros.nodes.filter_node"
RECORDER = "tactile_ros.nodes.recorder_node"
ROWS, COLUMNS = 24, 80


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "tactile_bringup.cli", *words]


class Terminal:
    """`tactile tune` in a terminal of the usual size."""

    def __init__(self, graph, *words: str) -> None:
        self.graph, self.shown = graph, ""
        self._ours, theirs = pty.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
        streams = {"stdin": theirs, "stdout": theirs, "stderr": theirs}
        self.process = subprocess.Popen(
            command("tune", *words),
            env=graph.variables | {"TERM": "xterm-256color"},
            **streams,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )
        os.close(theirs)
        os.set_blocking(self._ours, False)

    def __call__(self, keys: str, expected: str) -> None:
        """Type keys, and wait for a text on the screen; without keys one that may be there already."""
        self.shown = "" if keys else self.shown
        os.write(self._ours, keys.encode())
        assert self.graph.wait(lambda: self.says(expected)), self.shown[-4000:]

    def says(self, text: str) -> bool:
        with contextlib.suppress(BlockingIOError, OSError):
            self.shown += os.read(self._ours, 65536).decode(errors="replace")
        return text in self.shown

    def ended(self) -> int:
        """Its exit code, once it has ended."""
        assert self.graph.wait(lambda: self.says("\0") or self.process.poll() is not None)
        return self.process.returncode

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._ours)


@pytest.fixture
def terminal(graph):
    """One that shows the speed of a controller beside a recorder."""
    opened = []

    def start(*words: str) -> Terminal:
        opened.append(Terminal(graph, *words))
        return opened[-1]

    yield start
    for each in opened:
        each.close()


def test_settings_are_seen_changed_and_undone_and_all_of_it_is_recorded(graph, terminal, tmp_path):
    topics = ["/parameter_events rcl_interfaces/msg/ParameterEvent reliable"]
    topics += ["/arm/controller/status tactile_msgs/msg/ControllerStatus reliable"]
    graph.start(RECORDER, {"bag": str(tmp_path / "bag"), "topics": topics}, namespace="")
    graph.start(CONTROLLER)
    events = graph.collect(ParameterEvent, "/parameter_events")
    tune = terminal("controller task.speed")
    tune("", "1 settings of 1 nodes")
    tune("\r\x150.02\r", "in force: task.speed = 0.02")
    assert graph.get_parameter("controller", "task.speed") == 0.02
    tune("\r\x159\r", "/arm/controller refuses task.speed = 9: ")
    assert (
        graph.wait(lambda: tune.says("Max: 0.2")) and graph.get_parameter("controller", "task.speed") == 0.02
    )
    tune("u", "in force: task.speed = 0.01")
    tune("r", "in force: task.speed = 0.02")
    # as by `ros2 param set`, which asks for it in the same way (ros2cli, ros2param/api/__init__.py)
    assert graph.set_parameter("controller", "task.speed", 0.015).successful
    tune("", "/arm/controller task.speed = 0.015 by somebody else, was 0.02")
    tune("u", "it is 0.015 by somebody else")
    assert graph.get_parameter("controller", "task.speed") == 0.015
    done = subprocess.Popen(command("set", "/arm/controller", "task.speed=0.012"), env=graph.variables)
    assert graph.wait(lambda: done.poll() is not None) and done.returncode == 0
    tune("", "task.speed = 0.012 by somebody else")
    tune("d", "task.speed: 0.01 -> 0.012")
    folder = tmp_path / "saved"
    tune(f" w\x15{folder}\r", "written:")
    file = folder / "arm.controller.yaml"
    assert load_task(task_path("surface_following"), "ramp", controller=str(file))
    os.kill(tune.process.pid, signal.SIGINT)
    assert tune.ended() == 0 and str(file) in tune.shown.rpartition("\x1b[?1049l")[2]
    assert graph.get_parameter("controller", "task.speed") == 0.012, "nothing is taken back"

    changes = [e.changed_parameters[0].value.double_value for e in events if e.node == "/arm/controller"]
    assert changes == [0.02, 0.01, 0.02, 0.015, 0.012]
    graph.wait_for_count("recorder", "messages", len(changes))
    assert graph.stop(RECORDER) == 0
    recording = Recording(tmp_path / "bag", CellState())
    while recording.look_on():
        pass
    told = [event for event in recording.events if event.kind == "parameter"]
    assert [event.text for event in told] == [f"/arm/controller task.speed = {each}" for each in changes]
    bag = read_bag(tmp_path / "bag")
    stamps = {m.received_ns for m in bag.messages if m.topic == "/parameter_events"}
    at = [event.stamp_ns for event in told]
    assert set(at) <= stamps and at == sorted(set(at))


def test_nodes_that_come_and_go_are_seen(graph, terminal):
    graph.start(CONTROLLER)
    tune = terminal()
    tune("", "/arm/controller")
    graph.start(FILTER)
    tune("", "new: /arm/filter")
    graph.stop(FILTER)
    tune("", "gone: /arm/filter")
    tune("q", "\x1b[?1049l")  # the screen of before is there again
    assert tune.ended() == 0


def test_without_a_terminal_it_says_what_to_use(graph):
    done = subprocess.run(command("tune"), env=graph.variables, stdin=subprocess.DEVNULL, capture_output=True)
    assert done.returncode == 2
    said = " ".join(done.stderr.decode().split())
    assert "needs a terminal; without one use tactile get NODE, and tactile set NODE NAME=VALUE" in said
