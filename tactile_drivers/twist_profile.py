"""TwistProfile: the fastest way from one twist to another within limits of acceleration and jerk."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_drivers import _native
from tactile_drivers.arm import ArmLimits

Array = NDArray[np.float64]


class TwistProfile:
    """Goes towards target twists, each axis by itself, in up to three stretches of constant jerk.

    Attributes
    ----------
    twist, acceleration : ndarray (6,)
        Now, m/s and rad/s, m/s^2 and rad/s^2.
    """

    def __init__(self, limits: ArmLimits) -> None:
        self._limits = np.array([
            limits.linear_acceleration, limits.angular_acceleration, limits.linear_jerk, limits.angular_jerk
        ])  # fmt: skip
        self.start(np.zeros(6))

    def start(self, twist: ArrayLike) -> None:
        """Begin at a steady twist (6,)."""
        self.twist, self.acceleration = np.array(twist, dtype=np.float64), np.zeros(6)

    def advance(self, dt: float, target: Array) -> Array:
        """Go towards the target twist (6,) for `dt` seconds; returns the way (6,) meanwhile, m and rad."""
        moved, self.twist, self.acceleration = _native.advance(
            self.twist, self.acceleration, target, self._limits, dt
        )
        return moved
