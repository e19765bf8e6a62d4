"""What a scene says of an arm: limits, what it believes, and how well it does what it is told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import Settings, setting
from tactile_scene import _native

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ArmLimits(Settings):
    """Limits of commands by their norms, and of velocity, acceleration and jerk on each axis of the frame.

    While one command gives way to another the speed can pass its limit as a norm, but not on any axis.
    """

    linear_velocity: float = setting(0.1, unit="m/s", lower=1e-4, upper=5.0, doc="largest speed")
    angular_velocity: float = setting(1.0, unit="rad/s", lower=1e-3, upper=10.0, doc="largest angular speed")
    linear_acceleration: float = setting(
        1.0, unit="m/s^2", lower=1e-3, upper=50.0, doc="largest acceleration along each axis"
    )
    angular_acceleration: float = setting(
        10.0, unit="rad/s^2", lower=1e-2, upper=500.0, doc="largest angular acceleration about each axis"
    )
    linear_jerk: float = setting(
        50.0, unit="m/s^3", lower=1e-2, upper=1e4, doc="largest jerk along each axis"
    )
    angular_jerk: float = setting(
        500.0, unit="rad/s^3", lower=1e-1, upper=1e5, doc="largest angular jerk about each axis"
    )
    command_timeout: float = setting(
        0.1, unit="s", lower=0.001, upper=1.0, doc="age of the last command at which the arm stops by itself"
    )

    def braking_distance(self, speed: float, delay: float = 0.0) -> float:
        """Way (m) from a speed (m/s) to rest, `delay` (s) of it at that speed still.

        Never less than the way that acceleration and jerk allow: v^2 / 2a + v a / 2j where a is reached,
        v sqrt(v / j), which is less than that, where it is not.
        """
        return _native.braking_distance(speed, self.linear_acceleration, self.lead(delay))

    def braking_speed(self, distance: float, delay: float = 0.0) -> float:
        """The speed (m/s) whose `braking_distance` this is."""
        return _native.braking_speed(distance, self.linear_acceleration, self.lead(delay))

    def lead(self, delay: float) -> float:
        """How long (s) at its speed takes an arm that brakes after `delay` (s) as far as jerk makes it go."""
        return delay + self.linear_acceleration / (2.0 * self.linear_jerk)


@dataclass(frozen=True)
class WorkspaceSettings(Settings):
    """Where an arm may go."""

    workspace_lower: tuple[float, ...] = setting(
        (-2.0, -2.0, -2.0), length=3, lower=-20.0, upper=20.0, unit="m",
        doc="corner x y z of the box, in the arm's base, that the controlled frame's origin stays in",
    )  # fmt: skip
    workspace_upper: tuple[float, ...] = setting(
        (2.0, 2.0, 2.0), length=3, lower=-20.0, upper=20.0, unit="m", doc="the opposite corner"
    )

    def outside(self, position: ArrayLike, arm: str) -> str:
        """Why an arm of that name may not be there, (3,) m in its base; '' where it may."""
        p, lower, upper = np.asarray(position, dtype=np.float64), self.workspace_lower, self.workspace_upper
        if ((np.array(lower) <= p) & (p <= np.array(upper))).all():
            return ""
        where = f"({', '.join(f'{value:g}' for value in p)}) m"
        return f"{where} is outside the workspace of '{arm}', {list(lower)} to {list(upper)} m"


@dataclass(frozen=True)
class SafetySettings(WorkspaceSettings):
    """Where an arm may go, and what it believes of its commands and states."""

    largest_shear: float = setting(
        0.012, lower=1e-4, upper=0.1, unit="m", doc="shear of the tip at which the arm shears it no further"
    )
    contact_memory: float = setting(
        0.3, lower=0.0, upper=10.0, unit="s",
        doc="a belief bounds the motion for this long, carried along with the arm's own motion; without "
        "news of the contact an arm with a sensor backs off, or crawls",
    )  # fmt: skip
    crawl_speed: float = setting(
        0.002, lower=1e-4, upper=0.05, unit="m/s",
        doc="largest speed of an arm with a sensor of which nothing is heard; turning, of the tip's surface",
    )  # fmt: skip
    reaction_time: float = setting(
        0.02, lower=0.0, upper=1.0, unit="s", doc="from a state of the arm until its driver follows it"
    )
    future_tolerance: float = setting(
        0.02, lower=0.0, upper=1.0, unit="s", doc="a command may be stamped this far ahead of the clock"
    )
    owner_timeout: float = setting(
        0.5, lower=0.01, upper=60.0, unit="s", doc="silence after which the arm is nobody's any more"
    )
    singularity_slow: float = setting(
        0.03, lower=1e-3, upper=1.0, unit="m/rad",
        doc="smallest singular value of the Jacobian at which the arm begins to slow down",
    )  # fmt: skip
    singularity_stop: float = setting(
        0.01, lower=0.0, upper=1.0, unit="m/rad", doc="at which it comes no nearer; below singularity_slow"
    )
    min_arm_distance: float = setting(
        0.02, lower=0.0, upper=1.0, unit="m",
        doc="links and tool come no nearer to those of another arm with known kinematics; 0: nobody looks",
    )  # fmt: skip
    jump: float = setting(
        0.005, lower=1e-4, upper=1.0, unit="m",
        doc="a state further from the last than what was commanded takes the arm, and this, is a fault",
    )  # fmt: skip
    state_age: float = setting(
        0.2,
        lower=0.005,
        upper=10.0,
        unit="s",
        doc="states in motion later than this, on average, are a fault; from half of it on it is told",
    )


@dataclass(frozen=True)
class Box:
    """A box, in the arm's base, that the tip is kept out of; corners (3,), m."""

    name: str
    lower: Array
    upper: Array


@dataclass(frozen=True)
class TrackingSettings(Settings):
    """How well an arm does what it is told, and from when on it does not."""

    window: float = setting(
        0.1, lower=0.02, upper=1.0, unit="s", doc="over which ways are compared with what was told"
    )
    lag: float = setting(
        0.1, lower=0.0, upper=1.0, unit="s",
        doc="after this at the latest the arm does what it was told, but for its acceleration",
    )  # fmt: skip
    speed_tolerance: float = setting(
        0.002, lower=1e-4, upper=0.5, unit="m/s", doc="by which an arm may move otherwise than it was told"
    )
    angular_tolerance: float = setting(0.03, lower=1e-3, upper=5.0, unit="rad/s", doc="the same, turning")
    part: float = setting(0.3, lower=0.0, upper=1.0, doc="and by this part of the speed that it was told")
    patience: float = setting(
        0.4, lower=0.0, upper=10.0, unit="s",
        doc="an arm that does less than half of what it is told for this long is in fault",
    )  # fmt: skip
