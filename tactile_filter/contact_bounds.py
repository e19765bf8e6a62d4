"""What a sensor can feel at all: the bounds of a contact's pose, of what is known of it, and of its motion.

An estimate or a belief outside of them is wrong, whatever its covariance says.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings, setting
from tactile_filter import _fusion
from tactile_geometry import se3
from tactile_geometry.transform_buffer import MotionLimits

Array = NDArray[np.float64]

_SHEAR, _DEPTHS, _TILT = 0, (1, 2), 3  # of the limits, what C answers


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
        found = _fusion.contact_fault(mean, self._limits)
        if found is None:
            return ""
        fault, value = found
        if fault == _SHEAR:
            return f"shear is {value * 1e3:.4g} mm, must not exceed {self.largest_shear * 1e3:g} mm"
        if fault in _DEPTHS:
            low, high = self.least_depth * 1e3, self.largest_depth * 1e3
            return f"depth is {value * 1e3:.4g} mm, must be in [{low:g}, {high:g}] mm"
        name, limit = ("tilt", self.largest_tilt) if fault == _TILT else ("twist", self.largest_twist)
        return f"{name} is {math.degrees(value):.1f} degrees, must not exceed {math.degrees(limit):.0f}"

    def sigma_objection(self, cov: Array) -> str:
        """Why a covariance (6, 6) is none of an estimate of this sensor; empty if it is one."""
        part = _fusion.sigma_fault(cov, self._limits)
        if part is None:
            return ""
        what, unit = (("translation", "m"), ("rotation", "rad"))[part]
        found = ", ".join(f"{sigma:.3g}" for sigma in np.sqrt(cov.diagonal()[3 * part : 3 * part + 3]))
        right = f"[{self.least_sigma[part]:g}, {self.largest_sigma[part]:g}] {unit}"
        return f"standard deviations of the {what} are {found} {unit}, must be in {right}"

    @cached_property
    def _limits(self) -> Array:
        """As C takes them."""
        pose = [
            self.largest_shear,
            self.least_depth,
            self.largest_depth,
            self.largest_tilt,
            self.largest_twist,
        ]
        sigmas = zip(self.least_sigma, self.largest_sigma, strict=True)
        return np.array([*pose, *(sigma for pair in sigmas for sigma in pair)])

    def unreachable(self, before: tuple[int, Array], after: tuple[int, Array]) -> str:
        """Why a contact gets not from one stamped pose X_sf (ns, (4, 4)) to the other; empty if it does."""
        limits = MotionLimits(largest_speed=self.contact_speed, largest_turn_rate=self.contact_turn_rate)
        return limits.fault(before, after)


TACTIP = ContactBounds()
