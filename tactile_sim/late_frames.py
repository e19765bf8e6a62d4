"""Frames of a simulated camera that are stamped late, as those of a real one can be."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

from tactile_base.stamps import SECOND_NS
from tactile_geometry.transform_buffer import TransformBuffer
from tactile_sim.arm import SimArm
from tactile_sim.frame import Frame


class LateFrames:
    """Frames of a camera that are stamped when they come, and the scene's correction of these stamps.

    Parameters
    ----------
    delay : float
        From the exposure to the stamp, s.
    shift : float
        What the scene adds to the stamps, s; not above zero.
    rate : int
        Steps in a second.
    """

    def __init__(self, delay: float, shift: float, rate: int) -> None:
        self.frames: deque[tuple[int, Frame]] = deque()
        self._ticks = math.ceil(delay * rate - 1e-9)
        self._first = max(self._ticks, math.ceil(-shift * rate))  # before it, no pose is known at the stamp
        self._later_ns = round((delay + shift) * SECOND_NS)
        self._track = TransformBuffer(SECOND_NS)

    def see(self, arm: SimArm) -> None:
        """Remember where an arm says that the sensor is."""
        self._track.set_transform("base", "sensor", arm.stamp_ns, arm.T_base_controlled)

    def due(self, ticks: int, ticks_per_frame: int) -> bool:
        """Whether the frame of an exposure comes at this step."""
        exposed = ticks - self._ticks
        return ticks > self._first and exposed > 0 and exposed % ticks_per_frame == 0

    def take(self, ticks: int) -> Frame:
        """The frame that comes at this step; those before it that nobody took are lost."""
        while self.frames and self.frames[0][0] < ticks - self._ticks:
            self.frames.popleft()
        if not self.frames or self.frames[0][0] != ticks - self._ticks:
            raise ValueError("no frame comes at this step; see exposure_due")
        _, frame = self.frames.popleft()
        stamp_ns = frame.stamp_ns + self._later_ns
        T_base_sensor = self._track.lookup("base", "sensor", stamp_ns)
        return replace(frame, stamp_ns=stamp_ns, T_base_sensor=T_base_sensor)
