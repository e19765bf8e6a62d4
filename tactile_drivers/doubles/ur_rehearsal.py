"""UrRehearsal: the double of a UR in a rehearsal, a process beside that of the simulated cell."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_drivers.doubles.ur_controller import RTDE
from tactile_drivers.doubles.ur_robot import UrRobotSettings
from tactile_drivers.rotation_vectors import pose_of, vector_of
from tactile_drivers.scene import ArmScene
from tactile_drivers.ur import CB3, UrSettings, controlled_twist
from tactile_filter import se3

Array = NDArray[np.float64]

_VERSIONS = {CB3: (3, 15, 0, 0)}


class UrRehearsal:
    """See `tactile_drivers.doubles.rehearsal.Double`."""

    def __init__(self, arm: ArmScene) -> None:
        given = arm.driver_settings
        wanted = given.checked(UrSettings, given.values)
        self._T_tcp_controlled = arm.T_tool_controlled
        start = arm.T_base_start @ se3.inverse(self._T_tcp_controlled)
        settings = UrRobotSettings(
            model=wanted.model or "UR5",
            version=_VERSIONS.get(wanted.generation, UrRobotSettings().version),
            start=tuple(vector_of(start)),
            tcp_offset=wanted.tcp_offset,
            payload=wanted.payload,
        )
        self.stopped = False
        module, given_settings = "tactile_drivers.doubles.ur_controller", json.dumps(asdict(settings))
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, wanted.host, given_settings],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C is for those who drive the arm
        )
        assert self._process.stdout is not None
        if not self._process.stdout.readline():
            raise OSError(f"the double of a UR cannot have the ports of {wanted.host}; does it run already?")

    @staticmethod
    def settings(address: str) -> Mapping[str, Any]:
        """The address in place of the arm's."""
        return {"host": address}

    @staticmethod
    def wait(arm: ArmScene, seconds: float) -> None:
        """Return when the double takes connections, or after that time."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            with contextlib.suppress(OSError):
                socket.create_connection((arm.driver_settings.values["host"], RTDE), 1.0).close()
                return
            time.sleep(0.1)

    def now(self) -> tuple[int, Array, Array]:
        """Time (ns), pose (4, 4) in the base and twist (6,), in itself, of the controlled frame."""
        now_ns, pose, speed, self.stopped = self._ask("now")
        T = pose_of(pose) @ self._T_tcp_controlled
        return now_ns, T, controlled_twist(T, self._T_tcp_controlled, np.array(speed))

    def protective_stop(self) -> None:
        """Stop as after a collision."""
        self._ask("protective_stop")

    def close(self) -> None:
        """End it."""
        self._process.communicate()

    def _ask(self, line: str) -> Any:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())
