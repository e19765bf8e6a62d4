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

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import Settings, setting
from tactile_control.pose_steering import curvature, largest_curvature
from tactile_geometry import se3

Array = NDArray[np.float64]


LARGEST = 100.0  # rad/m: no object that a tip pushes turns faster
LEAST = 1.0  # rad/m: what turns less is not led anywhere


@dataclass(frozen=True)
class SteeringSettings(Settings):
    """How a `SteeringController` steers, and what it assumes of an object before it has moved."""

    enabled: bool = setting(
        False, doc="steer by the learnt model in place of target alignment, up to the target"
    )
    gain: float = setting(
        0.5, lower=0.0, upper=10.0, unit="1/s", doc="k: rate at which the target's offset is taken away"
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

    Attributes
    ----------
    turning, drift : float
        a and b, rad/m.
    """

    def __init__(self, settings: SteeringSettings) -> None:
        self.settings = settings
        deviations = np.array([settings.turning_deviation, settings.drift_deviation, math.pi])
        self._mean = np.array([settings.turning, 0.0, 0.0])
        self._assumed = np.diag(1.0 / np.maximum(deviations, 1e-6) ** 2)
        self._information = self._assumed.copy()
        self._weighted = self._assumed @ self._mean
        self._way = np.zeros(2)
        self._heading = 0.0
        self._last: tuple[Array, Array] | None = None
        self._solve()

    def update(self, position: Array, normal: Array, down: Array) -> None:
        """Take the contact frame's origin (3,), its z-axis and its x-axis, in a frame that stands still."""
        if self._last is not None:
            moved, before = position - self._last[0], self._last[1]
            sideways = np.cross(before, down)
            step = np.array([moved @ sideways, moved @ before])
            self._heading += math.atan2(float(np.cross(before, normal) @ down), float(before @ normal))
            self._way += step
            self._fit(se3.norm(step))
        self._last = position.copy(), normal.copy()

    def _fit(self, way: float) -> None:
        settings = self.settings
        kept = math.exp(-way / settings.memory)
        weight = min(1.0, way / settings.correlation) / settings.heading_deviation**2
        row = np.array([*self._way, 1.0])
        self._information = kept * self._information + (1.0 - kept) * self._assumed
        self._weighted = kept * self._weighted + (1.0 - kept) * (self._assumed @ self._mean)
        self._information += weight * np.outer(row, row)
        self._weighted += weight * row * self._heading
        self._solve()

    def _solve(self) -> None:
        turning, drift, _ = np.linalg.solve(self._information, self._weighted)
        self.turning = float(np.clip(turning, 0.0, LARGEST))
        self.drift = float(np.clip(drift, -LARGEST, LARGEST))


class SteeringController:
    """Sideways velocity from where the target is and how the object turns."""

    def __init__(self, settings: SteeringSettings) -> None:
        self.settings = settings
        self.model = TurningModel(settings)

    def configure(self, settings: SteeringSettings) -> None:
        """Replace the settings between two steps; what has been learnt stays."""
        self.settings = self.model.settings = settings

    def step(self, target: Array, speed: float) -> Array:
        """The velocity (6,) in {s'}, m/s, for a target (3,) there and a speed ahead, m/s."""
        settings, model = self.settings, self.model
        _, y, z = target
        gain = model.turning * z - 1.0
        return self._sideways(
            -(settings.gain * y + model.drift * speed * z) * gain / (gain**2 + settings.floor**2)
        )

    def step_to_pose(self, end: Array, direction: Array, speed: float) -> Array:
        """Sideways speed towards a place (3,) where the centre is to end, its axis along a direction (3,)."""
        settings, drift, turning = self.settings, self.model.drift, max(self.model.turning, LEAST)
        reach, crab = 1.0 / turning, drift / turning
        turn = angle_of(direction)
        bend = curvature(end[1:], turn, reach, crab, settings.straight, settings.line_length)
        return self._sideways(-(bend + drift) * speed / turning)

    def bends_at_most(self, end: Array, direction: Array, speed: float) -> tuple[float, float]:
        """Curvatures, 1/m: the largest on the way to a pose, and that which an assumed object can go."""
        settings = self.settings
        turning = max(settings.turning, LEAST)
        planned = largest_curvature(end[1:], angle_of(direction), 1.0 / turning, settings.straight)
        return planned, turning * settings.limit / speed

    def _sideways(self, wanted: float) -> Array:
        limit = self.settings.limit
        return np.array([0.0, min(max(wanted, -limit), limit), 0.0, 0.0, 0.0, 0.0])


def angle_of(direction: Array) -> float:
    """Of a direction (3,) in {s'}, rad: from its z-axis to its y-axis."""
    return math.atan2(direction[1], direction[2])
