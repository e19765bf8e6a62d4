"""Drivers of real arms behind the safe command stage, on doubles of their controllers: what tests share."""

import contextlib
import importlib
import json
import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from tactile_drivers.ownership import REST_FIRST
from tactile_drivers.safety import SafeArm
from tactile_scene.arm import ArmMode, open_arm
from tactile_scene.scene_file import load_scene

SPEED = 0.05  # m/s, at which faults are injected
ALONG = np.array([SPEED, 0.0, 0.0, 0.0, 0.0, 0.0])
ZERO = np.zeros(6)
STILL = 1e-5  # m/s, rad/s: a filter that fades away never ends
WITHIN = 0.2  # s, from a fault to rest
ATTEMPTS = 3  # a machine that does something else meanwhile may be late once
COMMANDS = 0.01  # s, between commands
PROMPT, PATIENT = 0.1, 1.0  # s without a state that a driver in motion calls silence: by default, and at most
LONGEST = 0.01  # s between two rows of a trace; where it is more the double was held up, and nothing moved

prompt = pytest.mark.parametrize("opened", [PROMPT], indirect=True, ids=["prompt"])
_addresses = iter(range(1, 255))


def address() -> str:
    """A loopback address that no other test uses at the same time."""
    return f"127.{os.getpid() // 250 % 250 + 1}.{os.getpid() % 250 + 1}.{next(_addresses)}"


def real_time() -> bool:
    """Whether this machine lets a thread have a real-time priority; it is tried in one that ends."""
    granted = []

    def ask():
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
            granted.append(True)

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    return bool(granted)


class Double:
    """The double of a controller in a process of its own; calling it says what goes wrong there.

    Attributes
    ----------
    mended : list of str
        What is said to have nothing go wrong any more.
    module : str
        What runs as the double.
    """

    mended: ClassVar[list[str]]
    module: ClassVar[str]

    def __init__(self, host: str, **settings):
        command = [sys.executable, "-m", self.module, host, json.dumps(settings)]
        self.host = host
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert json.loads(self._process.stdout.readline()) == "ready"

    def __call__(self, name: str, *numbers: float):
        self._process.stdin.write(" ".join([name, *map(str, numbers)]) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def mend(self) -> None:
        """Have nothing go wrong any more."""
        for line in self.mended:
            self(*line.split())

    def trace(self) -> np.ndarray:
        """Rows of time, pose (6), speed (6), target speed (6) since the last time, (n, 19)."""
        rows = [[time, *pose, *speed, *target] for time, pose, speed, target in self("trace")]
        return np.array(rows).reshape(-1, 19)

    def close(self) -> str:
        """End it; returns what it wrote to standard error."""
        return self._process.communicate(timeout=10)[1]


class Cell:
    """The arm of a scene behind `SafeArm`, and all that it says."""

    def __init__(self, scene: Path):
        self.arm = load_scene(scene).arms["arm"]
        self.safe = SafeArm(self.arm, time.time_ns, feels=False)
        self.states, self.refused = [], []
        self.driver = open_arm(self.arm, self._take)
        self.safe.attach_driver(self.driver)
        self.until(lambda: self.states, "a first state")

    def _take(self, state):
        complete = self.safe.take_state(state)
        if complete is None:
            self.refused.append(self.safe.bad_state)
        else:
            self.states.append(complete)

    @property
    def state(self):
        return self.states[-1]

    def command(self, twist, seconds: float = 0.0) -> str:
        """Command a twist over and over; returns the last refusal."""
        end = time.monotonic() + seconds
        while True:
            refusal = self.safe.command(time.time_ns(), twist, "test")
            if time.monotonic() >= end:
                return refusal
            time.sleep(COMMANDS)

    def move(self):
        """Bring the arm to 50 mm/s, from rest, as whoever commands it anew has to."""
        self.until(lambda: not self.command(ZERO), "arm that listens")

        def at_speed() -> bool:
            refusal = self.command(ALONG)
            assert self.state.mode is not ArmMode.FAULT, refusal  # which no waiting ends
            return not refusal and np.abs(self.state.twist - ALONG).max() < 1e-4

        self.until(at_speed, "50 mm/s")

    def until(self, done, what: str, patience: float = 15.0):
        """Wait for something."""
        end = time.monotonic() + patience
        while not done():
            assert time.monotonic() < end, f"no {what} within {patience:g} s; {self.states[-1:]}"
            time.sleep(COMMANDS)

    def rest(self):
        self.until(lambda: self.state.mode is ArmMode.RESTING, "rest")

    def close(self):
        self.safe.close()


def lasted(times: np.ndarray) -> float:
    """Seconds from the first to the last row of a trace, of those in which the double moved its arm."""
    return float(np.minimum(np.diff(times), LONGEST).sum())


def mend(cell, double):
    """Leave the arm at rest and ready, whatever went wrong before."""
    double.mend()

    def ready():
        try:
            cell.safe.reset()
        except RuntimeError:
            return False
        return not cell.command(ZERO)

    cell.until(ready, "arm that moves again")
    cell.command(ZERO, 0.05)
    cell.rest()


def stopped_by(cell, double, inject) -> tuple[float, float, str]:
    """Inject a fault at 50 mm/s and go on commanding; seconds and metres until rest, and the refusal."""
    cell.move()
    double.trace()
    since = inject()
    refusals = [cell.command(ALONG, 0.35)]

    def told() -> bool:  # a test that was held up hears first that it was silent
        refusals.append(cell.command(ALONG))
        return refusals[-1] not in ("", REST_FIRST)

    cell.until(told, "reason of the fault")
    refusal, trace = refusals[-1], double.trace()
    after = trace[trace[:, 0] >= since] if since is not None else trace
    moving = np.flatnonzero(np.abs(after[:, 7:13]).max(axis=1) > STILL)
    assert len(moving) < len(after), "the arm goes on"
    if not len(moving):
        return 0.0, 0.0, refusal
    last = moving[-1]
    assert last < len(after) - 1, "the arm has moved to the end"
    metres = float(np.linalg.norm(after[last, 1:4] - after[0, 1:4]))
    return lasted(after[: last + 1, 0]), metres, refusal


def check_stop(cell, double, inject, words: str, mode=ArmMode.FAULT):
    """A fault stops the arm in time, is told, and nothing goes on by itself."""
    for _ in range(ATTEMPTS):
        seconds, metres, refusal = stopped_by(cell, double, inject)
        assert re.search(words, refusal), refusal
        assert cell.state.mode is mode
        assert cell.state.reason in refusal
        print(f"at rest after {1e3 * seconds:.0f} ms and {1e3 * metres:.1f} mm: {refusal}")
        if seconds <= WITHIN:
            break
        mend(cell, double)
    assert seconds <= WITHIN
    assert metres <= SPEED * WITHIN
    double.mend()
    double.trace()
    assert cell.command(ALONG, 0.2), "it went on by itself"
    assert not (np.abs(double.trace()[:, 7:13]) > STILL).any()


def check_clock_jump(cell, double, seconds: float):
    """A controller's clock that jumps makes no stamp go back or ahead."""
    first = len(cell.states)
    double("clock", seconds)
    cell.until(lambda: len(cell.states) > first + 20, "states")
    stamps = np.array([state.stamp_ns for state in cell.states])
    assert (np.diff(stamps) >= 0).all()
    assert abs(stamps[-1] - time.time_ns()) < 1e9


def refusal(tmp_path, double, scene_file, fault: str, **settings) -> str:
    """Why the driver does not open; nothing has moved."""
    if fault:
        double(*fault.split())
    arm = load_scene(scene_file(tmp_path, double.host, **settings)).arms["arm"]
    with pytest.raises(RuntimeError) as raised:
        open_arm(arm, lambda state: None)
    assert not double.trace()[:, 7:13].any()
    return str(raised.value)


class ArmContract:
    """Tests that every driver of a real arm passes, as methods of a class `Test...` of its own module.

    They use the module's fixtures `cell` (the arm at rest and ready), `double`, and `other`, a double that
    nobody drives yet. A driver whose attributes these are not has no business below `SafeArm`.

    Attributes
    ----------
    button : str
        The double's word for the emergency stop that a person presses.
    pressed : str
        How the driver calls it.
    missing : str
        What is said where the driver's library is not installed.
    scene_file : staticmethod
        (folder, host, **driver_settings) -> path of a scene with the arm.
    """

    button: str
    pressed: str
    missing: str
    scene_file: staticmethod

    def test_a_driver_that_is_told_nothing_any_more_stops_its_arm_and_says_so(self, cell, double):
        for _ in range(ATTEMPTS):
            cell.move()
            double.trace()
            cell.rest()
            trace = double.trace()
            moving = np.flatnonzero((np.abs(trace[:, 7:13]) > STILL).any(axis=1))[-1]
            seconds = lasted(trace[: moving + 1, 0])
            assert "no command for" in cell.state.reason
            if seconds < WITHIN:
                break
        assert seconds < WITHIN

    def test_after_its_button_nothing_moves_until_it_is_out_and_a_reset_and_rest(self, cell, double):
        cell.move()
        double(self.button)
        cell.until(lambda: cell.state.mode is ArmMode.ESTOP, "emergency stop")
        with pytest.raises(RuntimeError, match=self.pressed):
            cell.safe.reset()
        double("restore")
        double.trace()
        assert self.pressed in cell.command(ALONG, 0.3)
        cell.safe.reset()
        cell.until(lambda: cell.state.mode is ArmMode.RESTING, "rest")
        assert "waits for a twist of zero" in cell.command(ALONG, 0.1)
        assert not double.trace()[:, 7:13].any()
        assert not cell.command(ZERO)
        assert not cell.command(ALONG)

    @prompt
    def test_a_connection_that_is_back_is_a_fault_until_a_reset(self, cell, double):
        cell.move()
        double("drop")
        cell.until(lambda: cell.state.reason.endswith("is back"), "connection")
        assert cell.state.mode is ArmMode.FAULT
        assert "is back" in cell.command(ALONG)
        cell.safe.reset()
        cell.until(lambda: not cell.command(ZERO), "an arm that follows")
        cell.move()

    def test_an_arm_that_says_it_is_somewhere_else_is_not_believed(self, cell, double):
        seen = len(cell.refused)
        double("jump", 0.05)
        cell.until(lambda: len(cell.refused) > seen, "refusal")
        assert "the arm cannot have moved by 5" in cell.refused[-1]

    def test_twists_of_the_sensor_move_and_turn_the_sensor(self, cell, double):
        """What the driver moves stands 65 mm behind it, turned by half a turn in the base."""
        twist = np.array([0.0, 0.02, 0.01, 0.2, 0.0, 0.1])
        before = cell.state.T_base_controlled
        cell.command(twist, 0.5)
        cell.until(
            lambda: not cell.command(twist) and np.abs(cell.state.twist - twist).max() < 4e-3, "that twist"
        )
        after = cell.state.T_base_controlled
        assert before[2, 2] == pytest.approx(-1.0)
        assert (before[:3, :3].T @ (after - before)[:3, 3])[1] > 0.005
        cell.command(ZERO, 0.3)

    def test_without_its_library_the_driver_says_what_to_type(self, tmp_path, monkeypatch):
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
        arm = load_scene(self.scene_file(tmp_path, "127.0.0.1")).arms["arm"]
        with pytest.raises(RuntimeError, match=self.missing):
            open_arm(arm, lambda state: None)

    def test_a_driver_that_is_closed_while_it_moves_leaves_the_arm_at_rest(self, tmp_path, other):
        cell = Cell(self.scene_file(tmp_path, other.host))
        cell.move()
        cell.close()
        other.trace()
        time.sleep(0.1)
        assert not other.trace()[:, 7:13].any()
        assert cell.state.T_base_controlled[0, 3] > 0.4
