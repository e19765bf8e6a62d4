"""The launcher against a fake cell: real processes, real DDS, and every way in which a run can end."""

import fcntl
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest
from launched import Launched

from tactile_base.process_limits import GRAPH, KIB, address_space
from tactile_bringup.launching.environment import free_domain_id

pytest.importorskip("rclpy", reason="needs ROS 2")
pytestmark = pytest.mark.ros

FAKES = Path(__file__).parent / "fakes"


PATHS = os.pathsep.join(filter(None, [str(FAKES), os.environ.get("PYTHONPATH")]))


def fake(folder: Path, fault: str = "", seconds: float = 0.3, goals: int = 1) -> list[str]:
    """The command line of `launch_fake.py`."""
    return [sys.executable, str(FAKES / "launch_fake.py"), str(folder), fault, str(seconds), str(goals)]


class Launch(Launched):
    """`launch_fake.py` with its fake cell; `before` it runs what a shell is to do."""

    def __init__(self, folder: Path, *, before: str = "", **options: str) -> None:
        variables = {name: options.pop(name) for name in list(options) if name.isupper()}
        shell = ["sh", "-c", f'{before} && exec "$@"', "sh"] if before else []
        super().__init__(folder, [*shell, *fake(folder, **options)], PYTHONPATH=PATHS, **variables)


@pytest.fixture
def start(tmp_path):
    launches = []

    def start(**options) -> Launch:
        folder = tmp_path / f"launch{len(launches)}"
        folder.mkdir()
        launches.append(Launch(folder, **options))
        return launches[-1]

    yield start
    for launch in launches:
        launch.kill()


def test_a_task_that_is_done_ends_with_0_and_leaves_nothing(start):
    launch = start(goals=2)
    assert launch.end() == 0, launch.output
    assert "[2/2] goal_1: done (50 mm" in launch.output
    assert re.search(r"ROS domain \d+ \((chosen|as set)\), discovery LOCALHOST", launch.output)
    assert "OUTCOME 0 True []" in launch.output
    assert launch.leaves_nothing(), launch.left()


def test_a_task_that_fails_ends_with_1_and_its_reason(start):
    launch = start(fault="fail", goals=2)
    assert launch.end() == 1
    assert "goal_0: lost the contact at 12 mm" in launch.output
    assert "goal_1" not in launch.output  # what comes after a failed goal is not run


def test_a_node_that_cannot_start_is_named_with_its_log(start):
    launch = start(fault="configure")
    assert launch.end() == 3
    assert "node /arm/cell ended with exit code 1" in launch.output
    assert f"log: {launch.folder}/logs/arm.cell.log" in launch.output
    assert "the model file is missing: /no/such/model.onnx" in launch.output


def test_a_node_that_dies_in_mid_run_ends_the_run_with_its_name_and_last_words(start):
    launch = start(fault="die", seconds=30)
    assert launch.end() == 3
    assert "node /arm/cell ended with exit code 7" in launch.output
    assert "FATAL: the gel is torn" in launch.output
    assert launch.leaves_nothing(), launch.left()


def test_nodes_that_do_not_become_active_are_named(start):
    launch = start(fault="never_active")
    assert launch.end() == 4
    assert "not active after 3 s: /arm/cell (not there yet)" in launch.output
    assert "note: the machine is overloaded: its cores were in use for 100% of" in launch.output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_brings_the_arm_to_rest_first(start, number):
    launch = start(seconds=30)
    launch.wait_for("arm: follow")
    launch.process.send_signal(number)
    assert launch.end() == 128 + number
    assert f"stopped by {number.name}: bringing the arm to rest" in launch.output
    assert f"OUTCOME {128 + number} True []" in launch.output
    assert "cancel requested" in (launch.folder / "logs" / "arm.cell.log").read_text()
    assert launch.leaves_nothing(), launch.left()


def held_up(launch) -> int:
    """Hold the cell up and ask for the end; its process."""
    launch.wait_for("arm: follow")
    cell = next(pid for pid, words in launch.running().items() if any("fake_cell" in word for word in words))
    os.kill(cell, signal.SIGSTOP)
    launch.process.send_signal(signal.SIGINT)
    launch.wait_for("bringing the arm to rest")
    return cell


def test_an_arm_that_is_held_up_is_waited_for(start):
    launch = start(seconds=30)
    cell = held_up(launch)
    time.sleep(1.3)
    os.kill(cell, signal.SIGCONT)
    assert launch.end() == 130
    assert "OUTCOME 130 True []" in launch.output


def test_of_an_arm_that_was_not_seen_at_rest_the_last_word_is_told(start):
    launch = start(seconds=30)
    cell = held_up(launch)
    launch.wait_for("arm was not seen at rest: it has not reported for ")
    os.kill(cell, signal.SIGCONT)
    assert launch.end() == 5
    assert "OUTCOME 5 False" in launch.output and "not every arm was seen at rest" in launch.output


def test_a_signal_during_the_start_ends_it(start):
    launch = start(fault="never_active")
    launch.wait_for("ROS domain")
    launch.process.send_signal(signal.SIGINT)
    assert launch.end() == 130
    assert not launch.running()


def test_a_launch_waits_for_the_end_of_another_one_in_its_domain(start):
    domain = str(free_domain_id())
    other = start(seconds=30, ROS_DOMAIN_ID=domain)
    other.wait_for("arm: follow")
    launch = start(ROS_DOMAIN_ID=domain)
    launch.wait_for("waiting for another launch to end: /arm/cell")
    assert not (launch.folder / "logs" / "arm.cell.log").exists()
    other.process.kill()
    assert launch.end() == 0, launch.output
    assert f"ROS domain {domain} (as set)" in launch.output
    assert launch.leaves_nothing(), launch.left()


def test_a_launch_beside_another_one_that_goes_on_in_its_domain_is_refused(start):
    domain = str(free_domain_id())
    other = start(seconds=60, ROS_DOMAIN_ID=domain)
    other.wait_for("arm: follow")
    launch = start(fault="impatient", ROS_DOMAIN_ID=domain)
    assert launch.end() == 4
    assert "nodes of these names run in this ROS domain already: /arm/cell; end them" in launch.output
    assert not (launch.folder / "logs" / "arm.cell.log").exists()
    assert other.process.poll() is None and "stopp" not in other.output


def test_a_node_that_ignores_signals_is_killed_and_said_so(start):
    launch = start(fault="deaf")
    assert launch.end() == 5, launch.output
    assert "/arm/cell took SIGKILL to end" in launch.output
    assert "node /arm/cell did not end when it was asked to; log: " in launch.output
    assert launch.leaves_nothing(), launch.left()


@pytest.mark.parametrize("number", [None, signal.SIGINT], ids=["task done", "Ctrl-C"])
def test_a_node_that_ends_badly_while_everything_is_stopped_is_told_and_counts(start, number):
    launch = start(fault="ends_badly", seconds=0.3 if number is None else 30)
    if number is not None:
        launch.wait_for("arm: follow")
        launch.process.send_signal(number)
    assert launch.end() == 5, launch.output
    how = "stopped by SIGINT" if number else "the task was done, but not all has ended in order"
    assert f"tactile launch: {how}" in launch.output
    assert "while everything was stopped: node /arm/cell ended with exit code 9; log: " in launch.output
    assert "stopped: the arm rests; logs: " in launch.output


@pytest.mark.parametrize(
    ("at_the_close", "complaint"),
    [
        ("disk full", "bag_0.mcap: cannot be written: File too large"),
        ("bag deleted", "bag_0.mcap: cannot be written: it was deleted or moved while it was being written"),
    ],
)
def test_a_recording_that_is_lost_at_its_close_is_told_and_counts(start, at_the_close, complaint):
    launch = start(fault="record", AT_THE_CLOSE=at_the_close)
    assert launch.end() == 5, launch.output
    assert "goal_0: done" in launch.output and "the task was done, but not all has ended" in launch.output
    assert "while everything was stopped: node /recorder ended with exit code 1; log: " in launch.output
    assert complaint in launch.output and "stopped: the arm rests; logs: " in launch.output


def test_a_bag_that_is_deleted_in_mid_run_ends_the_run_with_its_name(start):
    launch = start(fault="record", seconds=60)
    launch.wait_for("arm: follow")
    shutil.rmtree(launch.folder / "bag")
    assert launch.end() == 3, launch.output
    assert "node /recorder ended with exit code 1; log: " in launch.output
    assert "it was deleted or moved while it was being written" in launch.output
    assert "while everything was stopped" not in launch.output and "OUTCOME 3 True" in launch.output


def test_an_arm_that_has_come_to_rest_in_an_emergency_stop_rests(start):
    launch = start(fault="estop", seconds=30)
    assert launch.end() == 1
    assert "OUTCOME 1 True []" in launch.output and "not seen at rest" not in launch.output
    assert "goal_0: emergency stop" in launch.output


def test_an_arm_that_moves_in_an_emergency_stop_was_not_seen_at_rest(start):
    launch = start(fault="estop_and_on", seconds=30)
    assert launch.end() == 1
    told = "THE ARM DOES NOT STOP, press the emergency stop that is wired to it: emergency stop: button"
    assert launch.output.count(f"arm: {told}") == 1  # at once, before the wait for its rest
    assert f"arm was not seen at rest: it is in emergency stop: {told}" in launch.output
    assert "stopped: the arm did not report rest in time" in launch.output


def test_however_often_somebody_asks_for_the_end_the_last_word_tells_of_the_arm(start):
    launch = start(seconds=30)
    launch.wait_for("arm: follow")
    while "stopped: the arm" not in launch.output and launch.process.poll() is None:
        launch.process.send_signal(signal.SIGINT)
        time.sleep(0.02)
    launch.end()
    assert "stopped: the arm rests; logs: " in launch.output
    assert "Traceback" not in launch.output


@pytest.fixture
def in_terminal(tmp_path):
    """A launch in a terminal of its own, whose goal is under way: its process, our end of the terminal."""
    ours, theirs = pty.openpty()

    def take_terminal() -> None:
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    process = subprocess.Popen(
        fake(tmp_path, seconds=60), stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
        preexec_fn=take_terminal, env={**os.environ, "PYTHONPATH": PATHS},
    )  # fmt: skip
    terminal = Terminal(ours, theirs)
    terminal.read_until("arm: follow")
    yield process, terminal
    process.kill()
    process.wait()
    os.close(theirs)


class Terminal:
    """Both ends of a terminal, and what was shown in it."""

    def __init__(self, ours: int, theirs: int) -> None:
        self.ours, self.theirs, self.shown = ours, theirs, ""

    @property
    def gives_lines(self) -> bool:
        """Whether what is typed comes by the line, as a shell leaves it, and not by the key."""
        return bool(termios.tcgetattr(self.theirs)[3] & termios.ICANON)

    def read_until(self, wanted: str) -> None:
        while wanted not in self.shown:
            self.shown += os.read(self.ours, 65536).decode()


def test_a_terminal_that_is_closed_ends_a_launch_in_order(in_terminal, tmp_path):
    process, terminal = in_terminal
    os.close(terminal.ours)
    assert process.wait(60) == 128 + signal.SIGHUP
    assert "cancel requested" in (tmp_path / "logs" / "arm.cell.log").read_text()


def test_a_key_in_the_launchs_terminal_stops_all_arms_and_the_terminal_is_left_as_it_was(in_terminal):
    process, terminal = in_terminal
    assert not terminal.gives_lines
    os.write(terminal.ours, b"x")  # no key of ours
    os.write(terminal.ours, b" ")
    terminal.read_until("stopped: the arm rests")
    assert "emergency stop of all arms" in terminal.shown
    assert process.wait(60) == 1 and terminal.gives_lines
    os.close(terminal.ours)


def test_a_launch_runs_within_the_limits_that_it_asks_for(start):
    limits = f"ulimit -n {GRAPH.files} && ulimit -v {address_space(GRAPH) // KIB}"
    launch = start(before=limits)
    assert launch.end() == 0, launch.output


@pytest.mark.parametrize(
    ("before", "complaint"),
    [
        ("ulimit -n 24", "no process may have more than 24 files open, a node needs 64: type `ulimit -n "),
        ("ulimit -v 1500000", "no process may have more than 1500000 KiB of address space, a node needs "),
        ("export RMW_IMPLEMENTATION=none", "RMW_IMPLEMENTATION=none: ROS 2 cannot load it here; installed: "),
        ("export ROS_DOMAIN_ID=ten", "ROS_DOMAIN_ID = 'ten': must be a number"),
    ],
)  # fmt: skip
def test_what_would_end_nodes_in_their_middle_is_refused_before_one_is_started(start, before, complaint):
    launch = start(before=before)
    assert launch.end() == 2
    assert f"tactile launch: {complaint}" in launch.output and "Traceback" not in launch.output
    assert "nothing was started" in launch.output and not list(launch.folder.glob("logs/*"))


def test_a_killed_launcher_leaves_no_node_and_no_shared_memory(start):
    launch = start(seconds=30)
    launch.wait_for("arm: follow")
    launch.process.kill()
    assert launch.end() == -signal.SIGKILL
    assert launch.leaves_nothing(), launch.left()
