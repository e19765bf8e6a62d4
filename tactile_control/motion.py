"""Moves of the sensor by its own pose: to a pose through the air, and how far it has come along a path."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.array_math import NUMBERS
from tactile_base.settings import Settings, setting
from tactile_geometry import se3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TravelSettings(Settings):
    """Moves through the air to a pose: how fast, how near, and how long at most."""

    speed: float = setting(0.05, lower=1e-3, upper=1.0, unit="m/s", doc="speed through the air")
    angular_speed: float = setting(
        0.6, lower=1e-2, upper=6.3, unit="rad/s", doc="rotation speed through the air"
    )
    gain: float = setting(
        4.0, lower=0.1, upper=50.0, unit="1/s", doc="speed per distance left when coming to the goal"
    )
    height: float = setting(
        0.02, lower=0.0, upper=1.0, unit="m", doc="sideways moves are made so far above the goal (along -z)"
    )
    position_tolerance: float = setting(
        0.0002, lower=1e-6, upper=0.05, unit="m", doc="the goal is reached within this"
    )
    angle_tolerance: float = setting(
        0.005, lower=1e-5, upper=0.5, unit="rad", doc="the goal's orientation is reached within this"
    )
    timeout: float = setting(30.0, lower=0.1, upper=600.0, unit="s", doc="longest time to the goal")
    distance: float = setting(
        1.0, lower=1e-3, upper=20.0, unit="m", doc="a goal further away than this is taken for a mistake"
    )


@dataclass(frozen=True)
class Waypoint:
    """A pose of the sensor in the base to come to, and how near is near enough."""

    T_base_goal: Array
    position_tolerance: float
    angle_tolerance: float

    def reached(self, T_base_sensor: Array) -> bool:
        position, rotation = pose_difference(T_base_sensor, self.T_base_goal)
        return se3.norm(position) <= self.position_tolerance and se3.norm(rotation) <= self.angle_tolerance


def pose_difference(T_base_sensor: Array, T_base_goal: Array) -> tuple[Array, Array]:
    """Straight way (3,) m and rotation vector (3,) rad to the goal, both in the sensor frame."""
    R = T_base_sensor[:3, :3]
    turn = np.eye(4)
    turn[:3, :3] = R.T @ T_base_goal[:3, :3]
    return R.T @ (T_base_goal[:3, 3] - T_base_sensor[:3, 3]), se3.log(turn)[3:]


def way_to_start(T_base_sensor: Array, T_base_start: Array, settings: TravelSettings) -> list[Waypoint]:
    """Waypoints: up along the start's -z, across at travel height, down; only the last where it is near."""
    last = Waypoint(T_base_start, settings.position_tolerance, settings.angle_tolerance)
    offset = np.linalg.solve(T_base_start, T_base_sensor)[:3, 3]
    _, rotation = pose_difference(T_base_sensor, T_base_start)
    coarse = 10.0 * settings.position_tolerance, 10.0 * settings.angle_tolerance
    if np.hypot(*offset[:2]) <= coarse[0] and np.linalg.norm(rotation) <= coarse[1]:
        return [last]
    height = max(-float(offset[2]), settings.height)
    up = -T_base_start[:3, 2]
    lifted, above = T_base_sensor.copy(), T_base_start.copy()
    lifted[:3, 3] += up * (height + offset[2])
    above[:3, 3] += up * height
    return [Waypoint(lifted, *coarse), Waypoint(above, *coarse), last]


def twist_towards(T_base_sensor: Array, T_base_goal: Array, settings: TravelSettings) -> Array:
    """Twist (6,) in {s} straight to the goal, slower with the distance left, within the travel speeds."""
    position, rotation = pose_difference(T_base_sensor, T_base_goal)
    v = _capped(settings.gain * position, settings.speed)
    omega = _capped(settings.gain * rotation, settings.angular_speed)
    return np.concatenate([v, omega])


def path_twist(
    pose_at: Callable[[float], Array], seconds: float, rate: float, step: float, T_base_now: Array
) -> tuple[Array, Array]:
    """Of who follows a path of poses in the base, by its time, gone along at `rate` times its speed.

    Returns the path's own twist and the distance from it, (6,) in the frame that is at T_base_now; `step` is
    that of central differences, s.
    """
    X_error = se3.inverse(T_base_now) @ pose_at(seconds)
    own = se3.log(se3.inverse(pose_at(seconds - step)) @ pose_at(seconds + step)) * (rate / (2.0 * step))
    return se3.adjoint(X_error) @ own, se3.log(X_error)


class Odometer:
    """Arc length along the sensor's positions; moves shorter than `step` wait until they add up to it."""

    def __init__(self, step: float) -> None:
        self.step = step
        self.length = 0.0
        self._last: list[float] | None = None

    def add(self, position: Array) -> float:
        """Take in a position (3,) m and return the length so far, m."""
        now = position.tolist()
        if self._last is None:
            self._last = now
        moved = math.dist(now, self._last)
        if moved > self.step:
            self.length += moved
            self._last = now
        return self.length

    def break_off(self) -> None:
        """The next position starts a new stretch: the way to it does not count."""
        self._last = None


def smooth_ramp(elapsed: Any, duration: float, math: Any = NUMBERS) -> Any:
    """0 to 1 over `duration` s with zero slope at both ends; of many with arrays and their `math`."""
    x = math.clip(elapsed / duration if duration > 0.0 else 0.0 * elapsed + 1.0, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def _capped(vector: Array, largest: float) -> Array:
    norm = se3.norm(vector)
    return vector if norm <= largest else vector * (largest / norm)


def along_z(speed: float) -> Array:
    """Twist (6,) along the sensor's z axis, m/s."""
    return np.array([0.0, 0.0, speed, 0.0, 0.0, 0.0])
