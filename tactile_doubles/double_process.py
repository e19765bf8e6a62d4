"""A double in a process of its own, and what goes through its pipes: a line asks, a line of JSON answers."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tactile_drivers.rotation_vectors import controlled_twist, pose_of
from tactile_scene.scene import ArmScene

Array = NDArray[np.float64]

STATE_TIMEOUT = 0.5  # s, of the driver, on a machine that simulates a cell besides


def answer_to(line: str, faults: Mapping[str, Callable[..., Any]]) -> Any:
    """What a controller answers to a line, the name of something that may go wrong and its numbers."""
    name, *numbers = line.split() or [""]
    try:
        return faults[name](*map(float, numbers))
    except (KeyError, ValueError, TypeError):
        return f"'{line.strip()}' means nothing here; there are {', '.join(faults)}"


def be_in_time() -> None:
    """Give this thread a real-time priority where that is allowed: a controller has a computer of its own."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))


class DoubleProcess:
    """The double of an arm of a rehearsed scene; see `tactile_doubles.rehearsal.Double`.

    Attributes
    ----------
    module, port, stop : str, int, str
        What runs in the process, where clients find it, and what stops it as after a collision.
    """

    module: ClassVar[str]
    port: ClassVar[int]
    stop: ClassVar[str]

    def __init__(self, arm: ArmScene, host: str, settings: Mapping[str, Any]) -> None:
        self._T_tool_controlled = arm.T_tool_controlled
        self.stopped = False
        self._process = subprocess.Popen(
            [sys.executable, "-m", self.module, host, json.dumps(settings)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C is for those who drive the arm
        )
        assert self._process.stdout is not None
        if not self._process.stdout.readline():
            raise OSError(f"the double of '{arm.name}' cannot have {host}:{self.port}; does it run already?")

    @classmethod
    def wait(cls, arm: ArmScene, seconds: float) -> None:
        """Return when the double takes connections, or after that time."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            with contextlib.suppress(OSError):
                socket.create_connection((arm.driver_settings.values["host"], cls.port), 1.0).close()
                return
            time.sleep(0.1)

    def now(self) -> tuple[int, Array, Array]:
        """Time (ns), pose (4, 4) in the base and twist (6,), in itself, of the controlled frame."""
        now_ns, pose, speed, self.stopped = self.ask("now")
        T = pose_of(pose) @ self._T_tool_controlled
        return now_ns, T, controlled_twist(T, self._T_tool_controlled, np.array(speed))

    def protective_stop(self) -> None:
        """Stop as after a collision."""
        self.ask(self.stop)

    def close(self) -> None:
        """End it."""
        self._process.communicate()

    def ask(self, line: str) -> Any:
        """The controller's answer to a line: the name of something that may go wrong, and its numbers."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())
