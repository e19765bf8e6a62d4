"""UrRehearsal: the double of a UR in a rehearsal, a process beside that of the simulated cell."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from tactile_doubles.double_process import STATE_TIMEOUT, DoubleProcess
from tactile_doubles.ur_controller import RTDE
from tactile_doubles.ur_robot import UrRobotSettings
from tactile_drivers.rotation_vectors import vector_of
from tactile_drivers.ur_settings import CB3, UrSettings
from tactile_geometry import se3
from tactile_scene.scene import ArmScene

_WATCHDOG = 2.0  # Hz
_VERSIONS = {CB3: (3, 15, 0, 0)}


class UrRehearsal(DoubleProcess):
    """See `tactile_doubles.rehearsal.Double`."""

    module, port, stop = "tactile_doubles.ur_controller", RTDE, "protective_stop"

    def __init__(self, arm: ArmScene) -> None:
        given = arm.driver_settings
        wanted = given.checked(UrSettings, given.values)
        settings = UrRobotSettings(
            model=wanted.model or "UR5",
            version=_VERSIONS.get(wanted.generation, UrRobotSettings().version),
            start=tuple(vector_of(arm.T_base_start @ se3.inverse(arm.T_tool_controlled))),
            tcp_offset=wanted.tcp_offset,
            payload=wanted.payload,
            **_joints(arm),
        )
        super().__init__(arm, wanted.host, asdict(settings))

    @staticmethod
    def settings(address: str) -> Mapping[str, Any]:
        """The address in place of the arm's, and time for a machine that simulates a cell besides."""
        return {"host": address, "watchdog": _WATCHDOG, "state_timeout": STATE_TIMEOUT}


def _joints(arm: ArmScene) -> dict[str, Any]:
    """The double's settings of its joints, where those of the arm are known."""
    chain = arm.kinematics
    if chain is None:
        return {}
    try:
        return {"kinematics": str(chain.path), "joints": tuple(chain.reach(arm.T_base_start, chain.ready))}
    except ValueError as error:
        raise OSError(f"the start of '{arm.name}' is {error}") from error
