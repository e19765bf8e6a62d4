"""Steering a pushed object all the way to its target, by a model of how it turns that is learnt on the way.

The paper's target alignment is switched off near the target, since there the bearing answers the other way
(its appendix "Differential analysis of object pushing"). With the target at (y, z) in the reference sensor
frame {s'}, whose origin moves at u along y and v along z, and about whose x-axis the object turns at omega,

    dy/dt = omega z - u        omega = a u + b v        so        dy/dt = (a z - 1) u + b v z

a is the paper's alpha / r0; b is the turning with the way ahead, of a centre of friction beside the contact
normal. Both come of the motion so far: the heading of the contact normal is a y-way, b z-way and a constant,
fitted by recursive least squares that forget with the way, towards what was assumed before, which holds again
where nothing is learnt. The sideways velocity that takes y away at the rate k,

    u = -(k y + b v z) g / (g^2 + floor^2)        g = a z - 1

changes its sign with g, and is small where g is: there the object cannot be steered. Where the normal is to
end in a given direction as well, `pose_steering` says how the way is to bend.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.array_math import NUMBERS
from tactile_base.settings import Settings, setting
from tactile_control.pose_steering import curvature, largest_curvature
from tactile_control.predictive_steering import Plan

Array = NDArray[np.float64]


LARGEST = 100.0  # rad/m: no object that a tip pushes turns faster
LEAST = 1.0  # rad/m: what turns less is not led anywhere
OFFSET, PREDICTIVE = LAWS = ("offset", "predictive")


@dataclass(frozen=True)
class SteeringSettings(Settings):
    """How a `SteeringController` steers, and what it assumes of an object before it has moved."""

    enabled: bool = setting(
        False, doc="steer by the learnt model in place of target alignment, up to the target"
    )
    law: str = setting(
        OFFSET,
        choices=LAWS,
        doc="offset: takes the target's offset away at the rate `gain`; predictive: plans all the way to it",
    )
    gain: float = setting(
        0.5, lower=0.0, upper=10.0, unit="1/s", doc="k: rate at which the target's offset is taken away"
    )
    cone: float = setting(
        1.5, lower=0.1, upper=10.0,
        doc="law predictive: largest sideways speed over that ahead; within the motion cone the tip sticks",
    )  # fmt: skip
    reach: float = setting(
        0.012, lower=1e-3, upper=1.0, unit="m",
        doc="law predictive: an offset of the target that counts as much as a ratio of 1",
    )  # fmt: skip
    end_way: float = setting(
        1.0, lower=0.0, upper=10.0, unit="m", doc="law predictive: the end counts as so much way"
    )
    limit: float = setting(
        0.015, lower=0.0, upper=0.1, unit="m/s", doc="the sideways velocity is clipped to +- this"
    )
    floor: float = setting(
        0.2, lower=0.01, upper=1.0, doc="g, the part of a sideways motion that steers, counts as no less"
    )
    turning: float = setting(
        10.0, lower=0.0, upper=100.0, unit="1/m", doc="a before anything is known: alpha / r0"
    )
    turning_deviation: float = setting(
        5.0, lower=0.0, upper=100.0, unit="1/m", doc="standard deviation of a before anything is known"
    )
    drift_deviation: float = setting(
        2.0, lower=0.0, upper=100.0, unit="1/m", doc="standard deviation of b, whose mean is zero then"
    )
    heading_deviation: float = setting(
        0.02, lower=1e-4, upper=1.0, unit="rad", doc="standard deviation of measured headings from the model"
    )
    correlation: float = setting(
        0.002, lower=1e-5, upper=0.1, unit="m", doc="way over which deviations of the heading are alike"
    )
    memory: float = setting(
        0.06, lower=0.005, upper=10.0, unit="m", doc="way over which the past is forgotten (to 1/e)"
    )
    straight: float = setting(
        0.06, lower=0.0, upper=1.0, unit="m", doc="the last part of a way to a direction is a straight line"
    )
    line_length: float = setting(
        0.02, lower=1e-3, upper=1.0, unit="m", doc="way in which an offset from that line is taken away"
    )


class TurningModel:
    """Heading of a contact normal as a linear function of the way of the contact, fitted as it goes.

    Of one contact, in numbers, or of many side by side, in arrays `like` one of `math`.

    Attributes
    ----------
    turning, drift : float
        a and b, rad/m.
    """

    def __init__(self, settings: SteeringSettings, math: Any = NUMBERS, like: Any = 0.0) -> None:
        self.settings, self._math, none = settings, math, 0.0 * like
        deviations = settings.turning_deviation, settings.drift_deviation, pi
        turning, drift, constant = (1.0 / max(deviation, 1e-6) ** 2 for deviation in deviations)
        self._assumed = turning, 0.0, 0.0, drift, 0.0, constant  # upper triangle of the information
        self._mean = turning * settings.turning, 0.0, 0.0
        self._information = [none + part for part in self._assumed]
        self._weighted = [none + part for part in self._mean]
        self._way = [none, none]
        self._heading = none
        self._last: tuple[Array, Array] | None = None
        self._solve()

    def update(self, position: Array, normal: Array, down: Array) -> None:
        """Take the contact frame's origin (3,), its z-axis and its x-axis, in a frame that stands still."""
        if self._last is not None:
            moved, before = position - self._last[0], self._last[1]
            sideways = np.cross(before, down)
            turned = atan2(float(np.cross(before, normal) @ down), float(before @ normal))
            self.advance(float(moved @ sideways), float(moved @ before), turned)
        self._last = position.copy(), normal.copy()

    def advance(self, left: Any, ahead: Any, turned: Any) -> None:
        """Take the contact's way since the last, m, to its left and ahead, and its turn to the left, rad."""
        settings, math = self.settings, self._math
        self._heading = self._heading + turned
        self._way = [self._way[0] + left, self._way[1] + ahead]
        way = math.sqrt(left * left + ahead * ahead)
        kept = math.exp(-way / settings.memory)
        weight = math.clip(way / settings.correlation, 0.0, 1.0) / settings.heading_deviation**2
        y, z = self._way
        products = y * y, y * z, y, z * z, z, 1.0
        self._information = [
            kept * old + (1.0 - kept) * assumed + weight * new
            for old, assumed, new in zip(self._information, self._assumed, products, strict=True)
        ]
        self._weighted = [
            kept * old + (1.0 - kept) * assumed + weight * self._heading * new
            for old, assumed, new in zip(self._weighted, self._mean, (y, z, 1.0), strict=True)
        ]
        self._solve()

    def _solve(self) -> None:
        """By Cramer's rule."""
        a, b, c, d, e, f = self._information
        p, q, r = self._weighted
        first = d * f - e * e, c * e - b * f, b * e - c * d
        second = first[1], a * f - c * c, b * c - a * e
        determinant = a * first[0] + b * first[1] + c * first[2]
        turning, drift = (row[0] * p + row[1] * q + row[2] * r for row in (first, second))
        self.turning = self._math.clip(turning / determinant, 0.0, LARGEST)
        self.drift = self._math.clip(drift / determinant, -LARGEST, LARGEST)


class SteeringController:
    """Sideways velocity from where the target is and how the object turns; many side by side as the model."""

    def __init__(self, settings: SteeringSettings, math: Any = NUMBERS, like: Any = 0.0) -> None:
        self.settings, self._math = settings, math
        self.model = TurningModel(settings, math, like)
        self._plan = Plan(math, like)

    def configure(self, settings: SteeringSettings) -> None:
        """Replace the settings between two steps; what has been learnt stays."""
        self.settings = self.model.settings = settings

    def step(self, target: Array, speed: float, radius: float) -> Array:
        """The velocity (6,) in {s'}, m/s, for a target (3,) there and a speed ahead, m/s.

        `radius` (m) is how near to the target the tip's centre arrives.
        """
        _, y, z = target.tolist()
        return self._along_y(self.sideways(y, z, speed, radius))

    def sideways(self, y: Any, z: Any, speed: Any, radius: float) -> Any:
        """The sideways velocity, m/s, for a target at (y, z) and a speed ahead, m/s."""
        settings, model, clip = self.settings, self.model, self._math.clip
        if settings.law == PREDICTIVE:
            slope = self._plan.step(settings, (model.turning, model.drift), y, z, radius)
            return clip(slope * speed, -settings.limit, settings.limit)
        gain = model.turning * z - 1.0
        wanted = -(settings.gain * y + model.drift * speed * z) * gain / (gain * gain + settings.floor**2)
        return clip(wanted, -settings.limit, settings.limit)

    def step_to_pose(self, end: Array, direction: Array, speed: float) -> Array:
        """Sideways speed towards a place (3,) where the centre is to end, its axis along a direction (3,)."""
        settings, drift, turning = self.settings, self.model.drift, max(self.model.turning, LEAST)
        reach, crab = 1.0 / turning, drift / turning
        turn = angle_of(direction)
        bend = curvature(end[1:], turn, reach, crab, settings.straight, settings.line_length)
        limit = settings.limit
        return self._along_y(min(max(-(bend + drift) * speed / turning, -limit), limit))

    def bends_at_most(self, end: Array, direction: Array, speed: float) -> tuple[float, float]:
        """Curvatures, 1/m: the largest on the way to a pose, and that which an assumed object can go."""
        settings = self.settings
        turning = max(settings.turning, LEAST)
        planned = largest_curvature(end[1:], angle_of(direction), 1.0 / turning, settings.straight)
        return planned, turning * settings.limit / speed

    @staticmethod
    def _along_y(velocity: float) -> Array:
        return np.array([0.0, velocity, 0.0, 0.0, 0.0, 0.0])


def angle_of(direction: Array) -> float:
    """Of a direction (3,) in {s'}, rad: from its z-axis to its y-axis."""
    return atan2(direction[1], direction[2])
