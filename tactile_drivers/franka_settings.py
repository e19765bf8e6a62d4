"""What a scene says of a Franka arm, and which limits Franka documents for it."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

import numpy as np

from tactile_base.settings import Settings, setting
from tactile_scene.arm_settings import ArmLimits
from tactile_scene.scene import ArmScene

FR3, PANDA = "fr3", "panda"
#: Limits in Cartesian space, as norms of translation and rotation: velocity (m/s, rad/s), acceleration, jerk.
#: Source: "Control Interface Specification and Robot Limits", Franka Control Interface documentation, and
#: rate_limiting.h of libfranka 0.9 (Panda) and 0.21 (FR3). What franky 2.0 lets an FR3 have is the Panda's.
DOCUMENTED = {
    FR3: ((3.0, 2.5), (9.0, 17.0), (4500.0, 8500.0)),
    PANDA: ((1.7, 2.5), (13.0, 25.0), (6500.0, 12500.0)),
}
_PERIOD = 1e-3  # s, between commands
#: s: so many missing in a row end a motion (FCI documentation, Robot limits and behavior)
WATCHDOG = 20 * _PERIOD
#: Of a step in a command what passes libfranka's low-pass filter (100 Hz) in a period: T / (T + 1 / 2 pi f).
_FILTERED = _PERIOD / (_PERIOD + 1.0 / (2.0 * np.pi * 100.0))


@dataclass(frozen=True)
class FrankaSettings(Settings):
    """How the arm is reached, and what its controller should say of it."""

    host: str = setting("172.16.0.2", doc="address of the controller")
    model: str = setting(FR3, choices=tuple(DOCUMENTED), doc="of the arm; panda is the Franka Emika Robot")
    rate: float = setting(250.0, lower=20.0, upper=1000.0, unit="Hz", doc="of states")
    end_effector: tuple[float, ...] = setting(
        (0.0,) * 6, length=6, lower=-10.0, upper=10.0, unit="m, rad",
        doc="frame EE in the flange, position and rotation vector, as the controller has to have it; EE is "
        "the scene's tool frame",
    )  # fmt: skip
    mass: float = setting(
        0.0, lower=0.0, upper=50.0, unit="kg",
        doc="of end effector and load together, as the controller has to have it",
    )  # fmt: skip
    collision_torque: tuple[float, ...] = setting(
        (20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0), length=7, lower=1.0, upper=100.0, unit="Nm",
        doc="on each joint, above which the arm stops in a reflex",
    )  # fmt: skip
    collision_force: tuple[float, ...] = setting(
        (20.0, 20.0, 20.0, 25.0, 25.0, 25.0), length=6, lower=1.0, upper=100.0, unit="N, Nm",
        doc="on the tool, along and about x y z, above which the arm stops in a reflex",
    )  # fmt: skip
    realtime: bool = setting(True, doc="refuse to drive without a real-time kernel and its priorities")
    state_timeout: float = setting(
        0.1, lower=0.02, upper=1.0, unit="s",
        doc="silence or lateness of states that is a lost connection in motion; at rest ten times that",
    )  # fmt: skip
    connect_timeout: float = setting(10.0, lower=1.0, upper=60.0, unit="s", doc="for connecting")


def unfit(arm: ArmScene, settings: FrankaSettings) -> str:
    """Why no arm can be driven with these settings, here; '' if one can."""
    if importlib.util.find_spec("franky") is None:
        return "the Python package franky-control is missing: pip install franky-control"
    lever = float(np.linalg.norm(arm.T_tool_controlled[:3, 3]))
    for name, most in largest_limits(settings.model, arm.limits, lever).items():
        if (value := float(getattr(arm.limits, name))) > most:
            return f"limits.{name} = {value:g}: with a {settings.model} it has to be at most {most:.3g}"
    return ""


def largest_limits(model: str, limits: ArmLimits, lever: float) -> dict[str, float]:
    """What each limit may be, so that no command leaves the model's documented ones.

    Limits are of each axis of the controlled frame, which is `lever` (m) away from the end effector; those of
    Franka are norms at the end effector, which rotation moves too. A motion that takes over from another
    begins with the acceleration that the arm tells, where the last one ended with one of its own: between the
    two lie at most two accelerations, of which the filter passes a part in the first period, besides the jerk
    that is allowed.
    """
    speeds, accelerations, jerks = DOCUMENTED[model]
    axes = np.sqrt(3.0)
    whirl = axes * limits.angular_velocity
    per_jerk = 2.0 * _FILTERED / _PERIOD  # 1/s: jerk for each acceleration
    most = {
        "angular_velocity": speeds[1],
        "linear_velocity": speeds[0] - limits.angular_velocity * lever,
        "angular_acceleration": min(
            accelerations[1] / axes, (jerks[1] / axes - limits.angular_jerk) / per_jerk
        ),
    }
    turning = axes * limits.angular_acceleration * lever
    most["linear_acceleration"] = min(
        (accelerations[0] - turning - whirl**2 * lever) / axes,
        (jerks[0] / axes - limits.linear_jerk) / per_jerk - limits.angular_acceleration * lever,
    )
    return most
