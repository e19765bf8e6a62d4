"""Time from Enter to rest for `tactile stop`, cold and ready, and for the key in the launch's terminal.

    python bench/stop_time.py [surface_following] [--scene plane] [--loops 0 4] [--times 20]

Each time a launch of the task has its arms in motion in a terminal of its own, beside so many processes that
never rest; then the command is typed, or the key pressed, and what `arm/status` of each arm says is watched
from this process. At rest: the arm is in emergency stop and its twist is zero, by the stamp of that state.
Then it is reset, and the task is launched anew.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import os
import pty
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from latency_under_load import busy

from tactile_bringup.launching.environment import free_domain_id
from tactile_bringup.launching.operator import Operator
from tactile_msgs.msg import ArmStatus

CLI = [sys.executable, "-m", "tactile_bringup.cli"]
MOVES = 0.003  # m/s
PATIENCE = 90.0  # s


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


@contextlib.contextmanager
def moving(task: list[str], variables: dict[str, str]) -> Iterator[tuple[Terminal, Operator]]:
    """A launch whose arms all move, and somebody who listens."""
    with tempfile.TemporaryDirectory() as folder:
        launch = Terminal([*CLI, "launch", *task, "--priority", "20", "--out", folder], variables)
        try:
            with Operator(int(variables["ROS_DOMAIN_ID"])) as operator:

                def moves() -> bool:
                    launch.read()
                    working = [v.controller.at_work for v in operator.arms.values() if v.controller]
                    speeds = [np.hypot(*v.status.twist[:2]) for v in operator.arms.values() if v.status]
                    return bool(working) and all(working) and min(speeds) > MOVES

                wait(operator, moves)
                yield launch, operator
        finally:
            launch.end()


def until_rest(operator: Operator, begun_s: float) -> float:
    """Seconds from a time (of `time.time`) to the first state in which every arm is stopped and rests."""
    rested: dict[str, float] = {}

    def all_rest() -> bool:
        for name, view in operator.arms.items():
            status = view.status
            if status.mode == ArmStatus.ESTOP and not any(status.twist) and name not in rested:
                rested[name] = status.header.stamp.sec + 1e-9 * status.header.stamp.nanosec
        return len(rested) == len(operator.arms)

    wait(operator, all_rest)
    return max(rested.values()) - begun_s


def measure(way: str, task: list[str]) -> float:
    """One time, s."""
    variables = {**os.environ, "ROS_DOMAIN_ID": str(free_domain_id()), "TERM": "xterm"}
    with moving(task, variables) as (launch, operator):
        if way == "key":
            begun = time.time()
            launch.type(" ")
            return until_rest(operator, begun)
        if way == "cold":
            begun = time.time()
            with subprocess.Popen([*CLI, "stop", "--here"], env=variables, stdout=subprocess.DEVNULL):
                return until_rest(operator, begun)
        ready = Terminal([*CLI, "stop", "--ready"], variables)
        try:
            wait(operator, lambda: all(f"/{arm}" in ready.read() for arm in operator.arms))
            begun = time.time()
            ready.type(" ")
            return until_rest(operator, begun)
        finally:
            ready.end()


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", nargs="?", default="surface_following")
    parser.add_argument("--scene", default="plane")
    parser.add_argument("--loops", type=int, nargs="+", default=[0, 4])
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--ways", nargs="+", default=["cold", "ready", "key"])
    arguments = parser.parse_args()
    task = [arguments.task, "--scene", arguments.scene]
    print("| from | busy loops | times | median (ms) | largest (ms) |\n| --- | --- | --- | --- | --- |")
    for loops in arguments.loops:
        others = busy(loops)
        try:
            for way in arguments.ways:
                taken = [1e3 * measure(way, task) for _ in range(arguments.times)]
                middle, largest = np.median(taken), max(taken)
                print(f"| {way} | {loops} | {len(taken)} | {middle:.0f} | {largest:.0f} |", flush=True)
        finally:
            for other in others:
                other.kill()
                other.wait()


if __name__ == "__main__":
    main()
