"""Time from Enter to rest for `tactile stop`, cold and ready, and for the key in the launch's terminal.

    python bench/graph/stop_time.py [surface_following] [--scene two_arms] [--loops 0 4] [--times 20]

All arms of the task are in motion, beside so many processes that never rest; then the command is typed, or
the key pressed, and what `arm/status` of each arm says is watched from this process. At rest: every arm is in
emergency stop and its twist is zero, by the stamp of that state. Then the arms are reset, and go on; for the
key the task is launched anew each time.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Table, busy, parser

from tactile_bringup.launching.environment import free_domain_id
from tactile_bringup.launching.operator import Operator
from tactile_msgs.msg import ArmStatus

CLI = [sys.executable, "-m", "tactile_bringup.cli"]
MOVES = 0.003  # m/s
PATIENCE = 90.0  # s
PRIORITY = 20


def take_terminal() -> None:
    """Have a new process be the one that its terminal's keys are for."""
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


class Terminal:
    """A process in a terminal of its own, which is typed into."""

    def __init__(self, command: list[str], variables: dict[str, str]) -> None:
        self._ours, theirs = pty.openpty()
        ends = {"stdin": theirs, "stdout": theirs, "stderr": theirs}
        self.process = subprocess.Popen(
            command, env=variables, start_new_session=True, preexec_fn=take_terminal, **ends
        )
        os.close(theirs)
        os.set_blocking(self._ours, False)
        self.shown = ""

    def read(self) -> str:
        """All that it has shown."""
        with contextlib.suppress(BlockingIOError, OSError):
            while data := os.read(self._ours, 65536):
                self.shown += data.decode(errors="replace")
        return self.shown

    def type(self, key: str) -> None:
        """Press keys."""
        os.write(self._ours, key.encode())

    def end(self) -> None:
        """End it, whatever it does."""
        self.process.terminate()
        while self.process.poll() is None:
            self.read()
            time.sleep(0.02)
        os.close(self._ours)


def wait(operator: Operator, holds: Callable[[], bool]) -> None:
    """Listen until something holds."""
    end = time.monotonic() + PATIENCE
    while not holds():
        if time.monotonic() > end:
            raise TimeoutError("it never held")
        operator.look()


def all_move(operator: Operator) -> bool:
    """Whether every arm with a task moves."""
    views = [view for view in operator.arms.values() if view.controller]
    speeds = [np.linalg.norm(view.status.twist[:3]) for view in views if view.status]
    return len(speeds) == len(views) == len(operator.arms) > 0 and min(speeds) > MOVES


class Nodes:
    """The nodes of a task, running, and goals for all of its arms."""

    def __init__(self, task: str, scene: str, folder: Path, variables: dict[str, str]) -> None:
        launch = [*CLI, "launch", task, "--scene", scene, "--headless", "--nodes-only"]
        launch += ["--priority", str(PRIORITY), "--out", str(folder / "run")]
        self._run = [*CLI, "run", task, "--scene", scene, "--headless"]
        self._log = folder / "log"
        self._given = {"env": variables, "stdout": self._log.open("w"), "stderr": subprocess.STDOUT}
        self._launched = subprocess.Popen(launch, **self._given)
        self._task: subprocess.Popen[bytes] | None = None

    def move(self, operator: Operator) -> None:
        """Have all arms in motion."""
        task = self._task = subprocess.Popen(self._run, **self._given)

        def moves() -> bool:
            if task.poll() is not None:
                raise RuntimeError(f"the task has ended: {self._log.read_text()}")
            return all_move(operator)

        wait(operator, moves)

    def go_on(self, operator: Operator) -> None:
        """Leave the emergency stop, once the goals have ended."""
        self._task.wait(PATIENCE)
        for arm in operator.arms:
            operator.reset(arm)
        seen = time.monotonic() + 0.3  # by the controllers, too
        views = operator.arms.values()
        wait(operator, lambda: not any(v.stopped for v in views) and time.monotonic() > seen)

    def close(self) -> None:
        """End them."""
        for process in filter(None, (self._task, self._launched)):
            process.terminate()
            process.wait()
        self._given["stdout"].close()


def until_rest(operator: Operator, begun_s: float) -> float:
    """Seconds from a time (of `time.time`) to the first state in which every arm is stopped and rests."""
    rested: dict[str, float] = {}
    moving = {name: view for name, view in operator.arms.items() if view.controller}

    def all_rest() -> bool:
        for name, view in moving.items():
            status = view.status
            if status.mode == ArmStatus.ESTOP and not any(status.twist) and name not in rested:
                rested[name] = status.header.stamp.sec + 1e-9 * status.header.stamp.nanosec
        return len(rested) == len(moving)

    wait(operator, all_rest)
    return max(rested.values()) - begun_s


def stopped_by_command(ready: bool, task: str, scene: str, times: int) -> list[float]:
    """Seconds, of `tactile stop` typed so often."""
    variables = {**os.environ, "ROS_DOMAIN_ID": str(free_domain_id()), "TERM": "xterm"}
    taken: list[float] = []
    with tempfile.TemporaryDirectory() as folder, Operator(int(variables["ROS_DOMAIN_ID"])) as operator:
        nodes = Nodes(task, scene, Path(folder), variables)
        terminal = Terminal(["tactile", "stop", "--ready"], variables) if ready else None
        try:
            for _ in range(times):
                nodes.move(operator)
                if terminal is not None:
                    wait(operator, lambda: all(f"/{arm}" in terminal.read() for arm in operator.arms))
                    begun = time.time()
                    terminal.type(" ")
                    taken.append(until_rest(operator, begun))
                    said = len(operator.arms) * (len(taken))
                    wait(operator, lambda said=said: terminal.read().count("rests after") >= said)
                else:
                    begun = time.time()
                    with subprocess.Popen(
                        ["tactile", "stop", "--here"], env=variables, stdout=subprocess.DEVNULL
                    ):
                        taken.append(until_rest(operator, begun))
                nodes.go_on(operator)
        finally:
            if terminal is not None:
                terminal.end()
            nodes.close()
    return taken


def stopped_by_key(task: str, scene: str, times: int) -> list[float]:
    """Seconds, of the key in the terminal of a launch."""
    taken: list[float] = []
    for _ in range(times):
        variables = {**os.environ, "ROS_DOMAIN_ID": str(free_domain_id()), "TERM": "xterm"}
        with tempfile.TemporaryDirectory() as folder, Operator(int(variables["ROS_DOMAIN_ID"])) as operator:
            command = [*CLI, "launch", task, "--scene", scene, "--priority", str(PRIORITY), "--out", folder]
            launch = Terminal(command, variables)
            try:
                wait(operator, lambda launch=launch: bool(launch.read()) and all_move(operator))
                begun = time.time()
                launch.type(" ")
                taken.append(until_rest(operator, begun))
            finally:
                launch.end()
    return taken


WAYS = {
    "tactile stop": partial(stopped_by_command, False),
    "tactile stop --ready": partial(stopped_by_command, True),
    "space bar": stopped_by_key,
}


def main() -> None:
    """A row for each way and load."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("task", nargs="?", default="surface_following")
    arguments.add_argument("--scene", default="two_arms")
    arguments.add_argument("--loops", type=int, nargs="+", default=[0, 4])
    arguments.add_argument("--times", type=int, default=20)
    arguments.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS))
    given = arguments.parse_args()
    table = Table(("from", "busy loops", "times", "median (ms)", "largest (ms)"), "of all times", timed=True)
    for loops in given.loops:
        with busy(loops):
            for way in given.ways:
                ms = 1e3 * np.array(WAYS[way](given.task, given.scene, given.times))
                table.row(way, loops, len(ms), f"{np.median(ms):.0f}", f"{ms.max():.0f}")


if __name__ == "__main__":
    main()
