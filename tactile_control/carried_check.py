"""CarriedCheck: does the believed depth fit how the arm moves against the one that carries the object?

On a surface that may move, a depth that drifts slower than it does contradicts nothing. Where another arm
carries the object, that arm's tool says how it moves: seen from there the surface stands still, and the depth
and the normal can be held against this arm's way over it, as on a surface that stands still
(`surface_check`). That of the tool is heard of a little later, so beliefs wait for it::

    check = CarriedCheck(SurfaceSettings(carried=True))
    check.hear(tool)                                 # T_world_tool of the arm that carries, with its stamp
    check.add(stamp_ns, X_sf, T_world_sensor)
    check.doubt, check.contradiction                 # as of `SurfaceCheck`
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_control.phases import StampedPose, newer
from tactile_control.surface_check import Check, SurfaceCheck, SurfaceSettings
from tactile_geometry import se3
from tactile_geometry.transform_buffer import TransformBuffer, TransformUnavailable

Array = NDArray[np.float64]

MOST = 60  # beliefs that wait for the tool's pose
#: What a grip gives way in besides: of an honest follower the contact turns 19 degrees against its own twist.
IN_A_GRIP = {"shear_error": 0.05, "twist_error": 2.0}


class CarriedCheck(Check):
    """See the module's text; without `carried` it takes in nothing."""

    def __init__(self, settings: SurfaceSettings) -> None:
        self.settings = settings
        self._check = SurfaceCheck(_still(settings))
        self.begin()

    def configure(self, settings: SurfaceSettings) -> None:
        """Replace what is known of the surface; what the beliefs said so far stays."""
        self.settings = settings
        self._check.configure(_still(settings))

    def begin(self) -> None:
        """See `Check`."""
        super().begin()
        self._check.begin()
        self._tool = TransformBuffer(SECOND_NS)
        self._heard: StampedPose | None = None
        self._waiting: deque[tuple[int, Array, Array]] = deque(maxlen=MOST)

    def hear(self, tool: StampedPose | None) -> None:
        """Take the newest pose of the tool that carries the object, T_world_tool (4, 4)."""
        if newer(tool, self._heard):
            self._heard = tool
            self._tool.set_transform("world", "tool", tool.stamp_ns, tool.T)

    def add(self, stamp_ns: int, X_sf: Array, T_world_sensor: Array) -> None:
        """Take a belief's mean (4, 4) and the sensor's pose (4, 4), both of a stamp later than the last."""
        if not self.settings.carried:
            return
        self._waiting.append((stamp_ns, X_sf, T_world_sensor))
        while self._waiting and self._heard is not None and self._waiting[0][0] <= self._heard.stamp_ns:
            then_ns, X_sf, T_world_sensor = self._waiting.popleft()
            try:
                T_world_tool = self._tool.lookup("world", "tool", then_ns)
            except TransformUnavailable:
                continue  # from before the first word of the arm that carries
            self._check.add(then_ns, X_sf, se3.between(T_world_tool, T_world_sensor))
        self.doubt = self._check.doubt
        if self._check.contradiction:
            self.contradiction = f"{self._check.contradiction}, seen from the arm that carries the object"


def _still(settings: SurfaceSettings) -> SurfaceSettings:
    """What the surface is and does as seen from the tool; how deep it may be is said elsewhere."""
    return settings.replaced(
        speed=0.0,
        turn_rate=0.0,
        yields=settings.carried_yields,
        depth_error=settings.carried_error,
        depth_margin=0.1,
        **IN_A_GRIP,
    )
