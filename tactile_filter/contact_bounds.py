"""What a sensor can feel at all: the bounds of a contact's pose, of what is known of it, and of its motion.

An estimate or a belief outside of them is wrong, whatever its covariance says.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings, setting
from tactile_filter import se3
from tactile_filter.transform_buffer import MotionLimits

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ContactBounds(Settings):
    """Bounds of the surface contact pose X_fs; the defaults are those of a tip of 20 mm radius.

    Networks are trained to 5 mm of shear, 6 mm of depth, 25 degrees of tilt and 5 of twist.
    """

    largest_shear: float = setting(
        0.015, lower=0.001, upper=0.1, unit="m", doc="distance in the plane from where it was touched first"
    )
    least_depth: float = setting(
        -0.005,
        lower=-0.05,
        upper=0.0,
        unit="m",
        doc="below 0 the surface is not touched: errors of estimates",
    )
    largest_depth: float = setting(
        0.015, lower=0.001, upper=0.1, unit="m", doc="less than the radius of the tip"
    )
    largest_tilt: float = setting(
        math.radians(60.0), lower=0.1, upper=1.5, unit="rad", doc="angle of the sensor's axis to the normal"
    )
    largest_twist: float = setting(
        math.radians(60.0), lower=0.05, upper=math.pi, unit="rad", doc="turn about the normal, either way"
    )
    least_sigma: tuple[float, ...] = setting(
        (1e-5, 1e-4), lower=0.0, upper=0.1, length=2, unit="m, rad",
        doc="least standard deviations of an estimate: no network is that sure",
    )  # fmt: skip
    largest_sigma: tuple[float, ...] = setting(
        (0.05, 1.5), lower=1e-3, upper=10.0, length=2, unit="m, rad", doc="and the largest: it says nothing"
    )
    contact_speed: float = setting(
        0.25, lower=0.01, upper=10.0, unit="m/s",
        doc="of the contact in a sensor at rest: outliers further away than that start no new belief",
    )  # fmt: skip
    contact_turn_rate: float = setting(
        5.0, lower=0.05, upper=50.0, unit="rad/s", doc="the same of its rotation"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for least, largest in zip(self.least_sigma, self.largest_sigma, strict=True):
            if least >= largest:
                raise SettingError(f"least_sigma = {least:g}: must be below largest_sigma = {largest:g}")

    def pose(self, xi: Array) -> Array:
        """X_sf (4, 4) of its tangent vector (6,); raises `se3.PoseError` for one that no sensor can feel."""
        if not np.isfinite(xi).all():
            raise se3.PoseError(f"xi is not finite: {xi.tolist()}")
        X_sf = se3.exp(xi)
        if objection := self.objection(X_sf):
            raise se3.PoseError(objection)
        return X_sf

    def objection(self, mean: Array) -> str:
        """Why X_sf (4, 4) is no pose that the sensor can feel; empty if it is one."""
        (a, b, c, px), (d, e, f, py), (g, h, i, pz), _ = mean.tolist()  # X_fs is its inverse
        x, y, z = (-(u * px + v * py + w * pz) for u, v, w in ((a, d, g), (b, e, h), (c, f, i)))
        shear = math.hypot(x, y)
        if not shear <= self.largest_shear:
            return f"shear is {shear * 1e3:.4g} mm, must not exceed {self.largest_shear * 1e3:g} mm"
        if not self.least_depth <= z <= self.largest_depth:
            low, high = self.least_depth * 1e3, self.largest_depth * 1e3
            return f"depth is {z * 1e3:.4g} mm, must be in [{low:g}, {high:g}] mm"
        tilt, twist = math.atan2(math.hypot(c, f), i), math.atan2(b, a)
        for name, angle, limit in (("tilt", tilt, self.largest_tilt), ("twist", twist, self.largest_twist)):
            if not abs(angle) <= limit:
                degrees = math.degrees(angle), math.degrees(limit)
                return f"{name} is {degrees[0]:.1f} degrees, must not exceed {degrees[1]:.0f}"
        return ""

    def sigma_objection(self, cov: Array) -> str:
        """Why a covariance (6, 6) is none of an estimate of this sensor; empty if it is one."""
        variances = cov.diagonal().tolist()
        for part, what, unit in ((0, "translation", "m"), (1, "rotation", "rad")):
            three = variances[3 * part : 3 * part + 3]
            least, largest = self.least_sigma[part], self.largest_sigma[part]
            if not all(least * least <= variance <= largest * largest for variance in three):
                found = ", ".join(f"{sigma:.3g}" for sigma in np.sqrt(three))
                right = f"[{least:g}, {largest:g}] {unit}"
                return f"standard deviations of the {what} are {found} {unit}, must be in {right}"
        return ""

    def unreachable(self, before: tuple[int, Array], after: tuple[int, Array]) -> str:
        """Why a contact gets not from one stamped pose X_sf (ns, (4, 4)) to the other; empty if it does."""
        limits = MotionLimits(largest_speed=self.contact_speed, largest_turn_rate=self.contact_turn_rate)
        return limits.fault(before, after)


TACTIP = ContactBounds()
