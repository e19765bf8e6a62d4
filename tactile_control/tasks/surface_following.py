"""Surface following, the paper's Task 2: along a direction over a surface, at a depth, normal to it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings, setting
from tactile_control.contact_phases import INTO_CONTACT
from tactile_control.contact_settings import ContactTaskSettings
from tactile_control.contact_task import ContactTask
from tactile_control.motion import smooth_ramp
from tactile_control.phases import DONE, FAILED, RETREAT, STOPPING, Goal
from tactile_geometry import se3

Array = NDArray[np.float64]

FOLLOW = "follow"


@dataclass(frozen=True)
class FollowingSettings(Settings):
    """How a surface is followed."""

    speed: float = setting(
        0.010, lower=0.0, upper=0.2, unit="m/s", doc="reference speed along the surface while following"
    )
    ramp_time: float = setting(
        0.5, lower=0.0, upper=10.0, unit="s", doc="time in which the reference speed comes in, smoothly"
    )
    curvature: float = setting(
        0.0,
        lower=-200.0,
        upper=200.0,
        unit="1/m",
        doc="curvature of the sensor centre's path that is fed forward as rotation: > 0 over a bulge, 1 / "
        "(surface radius + tip radius - depth); 0 leaves the turning to feedback, as the paper does. "
        "Wants servoing.free_shear: else the turn about a sheared reference adds depth",
    )
    corridor: float = setting(
        0.004, lower=0.0, upper=1.0, unit="m",
        doc="the sensor's centre goes at most so far sideways of the path, seen along the surface's normal "
        "where that began, or the task fails: a tilt or a shear that is told wrongly leads astray. Wider for "
        "surfaces that turn the path themselves; 0: any width",
    )  # fmt: skip
    roll: float = setting(
        0.15, lower=0.0, upper=3.2, unit="rad",
        doc="and turns at most so far about the path's direction; more for surfaces that are twisted along "
        "it; 0: any angle",
    )  # fmt: skip
    timeout: float = setting(120.0, lower=0.1, upper=3600.0, unit="s", doc="longest following of one path")


@dataclass(frozen=True)
class SurfaceFollowingSettings(ContactTaskSettings):
    """All settings of surface following."""

    task: FollowingSettings = field(default_factory=FollowingSettings)


@dataclass(frozen=True)
class FollowingGoal(Goal):
    """One path over a surface."""

    direction_deg: float = setting(
        90.0,
        lower=-360.0,
        upper=360.0,
        unit="deg",
        doc="direction of motion in the xy-plane of the reference frame {s'}, from x towards y",
    )
    length: float = setting(
        0.1, lower=1e-4, upper=10.0, unit="m", doc="way of the sensor's centre after which the path is done"
    )
    target: tuple[float, ...] = setting(
        (),
        lower=-10.0,
        upper=10.0,
        unit="m",
        doc="position in the base where the path is done, 3 numbers or none; arriving nowhere near it within "
        "the length is then a failure",
    )
    target_radius: float = setting(
        0.002, lower=1e-6, upper=0.05, unit="m", doc="the target is reached within this"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.target) not in (0, 3):
            raise SettingError(f"target: must have 0 or 3 elements, has {len(self.target)}")


class SurfaceFollowing(ContactTask):
    """Follows one path over a surface."""

    settings_class = SurfaceFollowingSettings
    goal_class = FollowingGoal
    work = FOLLOW
    phases = (*INTO_CONTACT, FOLLOW, STOPPING, RETREAT, DONE, FAILED)

    settings: SurfaceFollowingSettings
    goal: FollowingGoal

    def reference_velocity(self, elapsed: float) -> Array:
        """Along the path, with the turning that a known curvature asks for."""
        settings = self.settings.task
        speed = settings.speed * smooth_ramp(elapsed, settings.ramp_time)
        direction = math.radians(self.goal.direction_deg)
        along = np.array([np.cos(direction), np.sin(direction), 0.0])
        turn = settings.curvature * speed * np.array([along[1], -along[0], 0.0])  # along x z
        return np.concatenate([speed * along, turn])

    def finished(self, elapsed: float) -> bool:
        """At the target if there is one, else at the end of the length."""
        if not self.goal.target:
            return self.odometer.length >= self.goal.length
        distance = np.linalg.norm(self.T_base_sensor[:3, 3] - np.array(self.goal.target))
        return bool(distance <= self.goal.target_radius)

    def failure(self, elapsed: float) -> str:
        """The target was missed, the arm went astray, or the path takes too long."""
        corridor, sideways = self.settings.task.corridor, abs(self.sideways)
        if 0.0 < corridor < sideways:
            return (
                f"the arm went {sideways * 1e3:.1f} mm sideways of its path (task.corridor = "
                f"{corridor * 1e3:g} mm): tilt or shear are told wrongly, or the surface turns the path"
            )
        limit, rolled = self.settings.task.roll, abs(self.rolled)
        if 0.0 < limit < rolled:
            return (
                f"the arm turned by {math.degrees(rolled):.1f} degrees about its path (task.roll = {limit:g} "
                "rad): its tilt is told wrongly, or the surface is twisted"
            )
        if self.odometer.length >= self.goal.length:
            return f"the target was not reached within {self.goal.length * 1e3:.1f} mm of path"
        if elapsed > self.settings.task.timeout:
            return f"the path was not done within {self.settings.task.timeout:g} s"
        return ""

    @property
    def sideways(self) -> float:
        """How far (m) the sensor's centre is to the left of its path, by the arm's pose alone."""
        direction, (x, y, _) = math.radians(self.goal.direction_deg), self.place
        return y * math.cos(direction) - x * math.sin(direction)

    @property
    def rolled(self) -> float:
        """By how much (rad) the sensor has turned about its path's direction, by the arm's pose alone."""
        direction = math.radians(self.goal.direction_deg)
        turn = se3.log(se3.between(self.T_base_work, self.T_base_sensor))[3:]
        return float(turn[0] * math.cos(direction) + turn[1] * math.sin(direction))

    def ahead(self) -> list[Array]:
        """To the target, or along the surface as it is felt here: how it bends nobody knows."""
        if self.phase != FOLLOW:
            return super().ahead()
        T, direction = self.T_base_reference.copy(), math.radians(self.goal.direction_deg)
        along = T[:3, :3] @ np.array([np.cos(direction), np.sin(direction), 0.0])
        left = max(0.0, self.goal.length - self.odometer.length)
        T[:3, 3] = self.goal.target or self.T_base_sensor[:3, 3] + left * along
        return [T]

    def fraction(self) -> float:
        """By the way so far."""
        return min(1.0, self.odometer.length / self.goal.length)
