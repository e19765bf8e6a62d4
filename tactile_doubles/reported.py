"""ReportedDouble: a double for any driver, which stands where the driver says that its arm does.

There is no robot behind it and no protocol: the driver is opened as `settings` say, with the maker's own
simulator, or a robot that is far from everything. The simulated cell follows the poses that it reports, so
that what the sensor feels is what those twists lead to. A package that brings a driver registers it under
the driver's name in the group "tactile_servoing.doubles", as it is or with settings of its own::

    class MyDouble(ReportedDouble):
        @staticmethod
        def settings(address):
            return {"host": "127.0.0.1"}     # the simulator of the maker, and never the robot
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_geometry import se3
from tactile_scene.scene import ArmScene

Array = NDArray[np.float64]

_SPAN_NS = 20_000_000  # over which the twist is taken from poses


class ReportedDouble:
    """See `tactile_doubles.rehearsal.Double`; whoever hears of its poses calls `take`.

    Attributes
    ----------
    stop_asked : bool
        Whether the cell has asked for a stop as after a collision, which only a person or a node can give it.
    """

    stopped = False

    def __init__(self, arm: ArmScene) -> None:
        self._T_tool_controlled = arm.T_tool_controlled
        self._poses = [(0, arm.T_base_start)]
        self.stop_asked = False

    @staticmethod
    def settings(address: str) -> Mapping[str, Any]:
        """None in place of the scene's."""
        return {}

    @staticmethod
    def wait(arm: ArmScene, seconds: float) -> None:
        """There is nothing to wait for."""

    def take(self, stamp_ns: int, T_base_tool: Array) -> None:
        """Take where its tool is, (4, 4), at a stamp."""
        if self._poses[-1][0] >= stamp_ns or stamp_ns - self._poses[-1][0] > SECOND_NS:
            self._poses.clear()  # another time
        self._poses.append((stamp_ns, T_base_tool @ self._T_tool_controlled))
        while len(self._poses) > 2 and stamp_ns - self._poses[1][0] >= _SPAN_NS:
            del self._poses[0]

    def now(self) -> tuple[int, Array, Array]:
        """Time (ns), pose (4, 4) in the base and twist (6,), in itself, of the controlled frame."""
        (before_ns, before), (stamp_ns, T) = self._poses[0], self._poses[-1]
        if stamp_ns == before_ns:
            return stamp_ns, T, np.zeros(6)
        return stamp_ns, T, se3.log(se3.inverse(before) @ T) * SECOND_NS / (stamp_ns - before_ns)

    def protective_stop(self) -> None:
        """Ask for a stop as after a collision."""
        self.stop_asked = True

    def ask(self, line: str) -> str:
        """Nothing goes wrong by a line."""
        return "there is no controller behind this double: its driver's arm is its own"

    def close(self) -> None:
        """There is nothing to end."""
