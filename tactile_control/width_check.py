"""WidthCheck: does an object that two arms hold between them become thinner?

A depth that drifts and an object that moves lead to the same beliefs of one arm. Two that press against one
object know more: however they move it, and wherever their contacts slide to, it stays as wide as it was. With
the believed features at p and q and their normals m and n, into the object and all in the world,

    width = (q - p) . (m - n) / 2

A tip that is deeper than it is believed to be makes it thinner. Normals that are not quite opposite, as at
round objects, count with the square of their angle::

    check = WidthCheck(SurfaceSettings(width_error=0.0014))
    check.hear(partner)                     # T_world_feature of the other one, with its stamp
    check.add(own)                          # and this one's
    check.doubt, check.contradiction        # as of `SurfaceCheck`
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import NANOSECOND, SECOND_NS
from tactile_control.phases import StampedPose, newer
from tactile_control.surface_check import BIN, LEAST_NUMBER, Check, SurfaceSettings
from tactile_geometry.transform_buffer import TransformBuffer, TransformUnavailable

Array = NDArray[np.float64]

GAP_NS = SECOND_NS // 2  # without a width for so long, the contacts may be others
MOST = 60  # features of the partner that wait for one of this arm


class WidthCheck(Check):
    """Compares the width of now with the largest of the last `memory`; see the module's text."""

    def __init__(self, settings: SurfaceSettings) -> None:
        self.settings = settings
        self.begin()

    def configure(self, settings: SurfaceSettings) -> None:
        """Replace what is allowed; what was seen so far stays."""
        self.settings = settings

    def begin(self) -> None:
        """See `Check`."""
        super().begin()
        self._own = TransformBuffer(SECOND_NS)
        self._heard: StampedPose | None = None
        self._waiting: deque[StampedPose] = deque(maxlen=MOST)
        self._forget()

    def _forget(self) -> None:
        self._gathered: list[tuple[int, float]] = []
        self._kept: deque[tuple[float, float]] = deque()  # time (s) and width (m)

    def hear(self, partner: StampedPose | None) -> None:
        """Take the newest feature of the other arm in the world, T_world_feature (4, 4)."""
        if newer(partner, self._heard):
            if self._heard is not None and partner.stamp_ns - self._heard.stamp_ns > GAP_NS:
                self._forget()
            self._heard = partner
            self._waiting.append(partner)

    def add(self, own: StampedPose) -> None:
        """Take this arm's, of a stamp later than the last."""
        self._own.set_transform("world", "feature", own.stamp_ns, own.T)
        if self._heard is not None and self._heard.stamp_ns > own.stamp_ns + GAP_NS:
            self._heard = None  # by another clock
            self._waiting.clear()
        while self._waiting and self._waiting[0].stamp_ns <= own.stamp_ns:
            partner = self._waiting.popleft()
            try:
                self._take(
                    partner.stamp_ns, self._own.lookup("world", "feature", partner.stamp_ns), partner.T
                )
            except TransformUnavailable:
                continue  # from before this contact

    def _take(self, stamp_ns: int, T: Array, T_partner: Array) -> None:
        apart = T_partner[:3, 3] - T[:3, 3]
        width = 0.5 * float(apart @ (T[:3, 2] - T_partner[:3, 2]))
        if self._gathered and stamp_ns - self._gathered[-1][0] > GAP_NS:
            self._forget()
        since_ns = stamp_ns - self._gathered[0][0] if self._gathered else 0
        if len(self._gathered) >= LEAST_NUMBER and since_ns >= 0.999 * BIN * SECOND_NS:
            stamps, widths = zip(*self._gathered, strict=True)
            self._compare(sum(stamps) / len(stamps) * NANOSECOND, sum(widths) / len(widths))
            self._gathered = []
        self._gathered.append((stamp_ns, width))

    def _compare(self, time: float, width: float) -> None:
        """The mean of some widths against those kept."""
        limit = self.settings.width_error
        while self._kept and time - self._kept[0][0] > self.settings.memory:
            self._kept.popleft()
        self._kept.append((time, width))
        then, widest = max(self._kept, key=lambda kept: kept[1])
        self.doubt = (widest - width) / limit if limit and self.settings.checked else 0.0
        if self.doubt > 1.0 and not self.contradiction:
            thinner = f"{(widest - width) * 1e3:.1f} mm thinner"
            self.contradiction = (
                f"within {time - then:.1f} s the object between both arms became {thinner}: the estimates of "
                "one of them contradict the motion of both"
            )
