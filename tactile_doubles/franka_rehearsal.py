"""FrankaRehearsal: the double of a Franka in a rehearsal, a process beside that of the simulated cell."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from typing import Any

from tactile_doubles.double_process import STATE_TIMEOUT, DoubleProcess
from tactile_drivers.franka_settings import FrankaSettings
from tactile_drivers.rotation_vectors import vector_of
from tactile_geometry import se3
from tactile_scene.scene import ArmScene

_TOLERANCE = 5.0  # a machine that simulates a cell besides is no real-time machine


class FrankaRehearsal(DoubleProcess):
    """See `tactile_doubles.rehearsal.Double`."""

    module, port, stop = "tactile_doubles.franka_controller", 1337, "cartesian_reflex"

    def __init__(self, arm: ArmScene) -> None:
        if importlib.util.find_spec("franky_sim") is None:
            raise OSError("the Python package franky-sim is missing: pip install franky-control franky-sim")
        given = arm.driver_settings
        wanted = given.checked(FrankaSettings, given.values)
        settings = {
            "model": wanted.model,
            "start": vector_of(arm.T_base_start @ se3.inverse(arm.T_tool_controlled)).tolist(),
            "end_effector": wanted.end_effector,
            "mass": wanted.mass,
            "tolerance": _TOLERANCE,
        }
        super().__init__(arm, wanted.host, settings)

    @staticmethod
    def settings(address: str) -> Mapping[str, Any]:
        """The address in place of the arm's, on a machine that simulates a cell and is no real-time one."""
        return {"host": address, "realtime": False, "state_timeout": STATE_TIMEOUT}
