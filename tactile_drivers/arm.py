"""Arm: what every arm driver offers, simulated or real, and what it is told about the arm that it drives.

A driver is a class in the registry `ARMS`; a scene names it, and another package adds its own by an entry
point of the group "tactile_servoing.arms" (docs/scenes.md)::

    class MyArm:
        settings_class = MyArmSettings               # checked against `driver_settings` of the scene

        def __init__(self, arm: ArmScene, settings: MyArmSettings, report: Callable[[ArmState], None]):
            ...                                      # connect; then report(state) at each new state

Twists and poses are those of the arm's controlled frame: its tactile sensor's, or the tool's where it has
none (`ArmScene.controlled_frame`, which stands in the tool at `ArmScene.T_tool_controlled`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.contract import Contract
from tactile_base.raised import defined_in
from tactile_base.registry import Registry
from tactile_base.settings import SettingError, Settings, setting
from tactile_drivers import _native

if TYPE_CHECKING:
    from tactile_drivers.scene import ArmScene

Array = NDArray[np.float64]


AT_REST = np.repeat([1e-3, 5e-3], 3)  # m/s, rad/s: what speeds say of an arm that does not move
LONGEST_CALL = 0.01  # s, that `command` and `stop` of a driver may take
HELD_UP = "machine or line to the arm is held up: end what else runs, or use --priority"  # of late states


class ArmMode(IntEnum):
    """What the arm does; the values are those of tactile_msgs/ArmStatus."""

    RESTING = 0
    MOVING = 1
    STOPPING = 2
    FAULT = 3
    ESTOP = 4


def is_at_rest(twist: ArrayLike) -> bool:
    """Whether speeds (6,), m/s and rad/s, are those of an arm that does not move; NaN is not."""
    return bool((np.abs(twist) < AT_REST).all())


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
        0.02,
        lower=0.0,
        upper=1.0,
        unit="s",
        doc="from a state of the arm until its driver follows the answer",
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
class ArmState:
    """State of the arm at a stamp; down to `speed_scaling` it is the driver's, the rest the safe stage's.

    Attributes
    ----------
    T_base_controlled : ndarray (4, 4)
        Pose of the controlled frame in the arm's base.
    twist : ndarray (6,)
        Twist [v (m/s), omega (rad/s)] of the controlled frame, in the controlled frame.
    reason : str
        Why the arm does what it does; empty in normal operation.
    joints : ndarray (n,) or None
        Angles of the joints, rad, of an arm whose driver has `kinematics`.
    speed_scaling : float
        The part (0 to 1) of what it is told that the arm is set to do, by a slider at its pendant say.
    owner : str
        Who commands the arm; empty for nobody.
    command_age : float
        Seconds since the stamp of the command in force; -1 while there is none.
    limited : bool
        True while the arm does less than it is asked for.
    held_back : str
        Which bound of speed, depth, shear, workspace, joints or other arms makes the command less; or empty.
    refused, refused_source : str
        Why the last command was not followed, and whose it was; empty if it was followed.
    remark : str
        What is not as it should be and no fault yet; or empty.
    """

    stamp_ns: int
    T_base_controlled: Array
    twist: Array
    mode: ArmMode
    reason: str = ""
    joints: Array | None = None
    speed_scaling: float = 1.0
    owner: str = ""
    command_age: float = -1.0
    limited: bool = False
    held_back: str = ""
    refused: str = ""
    refused_source: str = ""
    remark: str = ""


class Arm(Protocol):
    """A driver that has been opened. Any thread may call it, and `stop` while another call is under way.

    Attributes
    ----------
    keeps_limits : bool
        Whether it keeps the limits of acceleration and jerk itself. If not, it is given twists that do, one
        after each of its states.
    prompt : bool, optional
        Whether `command` and `stop` always return at once, since they wait for nothing. Without it they are
        called in threads of their own (`tactile_drivers.sender`).
    shared : bool, optional
        Whether others may move the arm while nobody commands it here. Without it that is a fault.
    kinematics : Kinematics, optional
        Of an arm that has them; then its states tell `joints`, and the stage minds their limits.
    watchdog : float, optional
        Seconds without commands after which the arm's own controller stops it, if this computer hangs, too.
    agreed : str, optional
        What its controller says as the scene does (tool, payload, model), since it would not have opened
        else.
    """

    keeps_limits: bool

    def command(self, stamp_ns: int, twist: ArrayLike) -> None:
        """Follow a twist (6,) of the controlled frame, in that frame, emitted at `stamp_ns`.

        It comes from the safe command stage, which has refused what no arm may follow. It returns within
        `LONGEST_CALL`; a longer call is told, and commands that come meanwhile are left out but the newest.
        """

    def stop(self, reason: str) -> None:
        """Bring the arm to rest within its limits; the next command moves it again.

        It returns within `LONGEST_CALL`, also while `command` has not returned yet.
        """

    def recover(self) -> None:
        """Leave a fault, if the arm allows it; `RuntimeError` says why it does not."""

    def close(self) -> None:
        """Stop, and let go of the arm; no state is reported after it returns."""


class ArmDriver(Protocol):
    """What an entry of `ARMS` is.

    Called with the arm of the scene, the driver's own settings, and what to call with each new state, from
    any thread. Raises `OSError` or `RuntimeError`, in words for its user, if the arm cannot be had.
    """

    settings_class: ClassVar[type[Settings]]

    def __call__(self, arm: ArmScene, settings: Any, report: Callable[[ArmState], None]) -> Arm: ...


#: Arm drivers by name, besides the simulated cell's.
ARMS: Registry[ArmDriver] = Registry(
    "arm driver",
    "tactile_servoing.arms",
    {"franka": "tactile_drivers.franka:FrankaArm", "ur": "tactile_drivers.ur:UrArm"},
    Contract(
        ("arm", "settings", "report"),
        {"command": ("stamp_ns", "twist"), "stop": ("reason",), "recover": (), "close": ()},
        settings=True,
    ),
)


def open_arm(arm: ArmScene, report: Callable[[ArmState], None]) -> Arm:
    """The arm of a scene, driven by the driver that the scene names.

    Raises
    ------
    SettingError
        If there is no such driver, it has no `keeps_limits`, or `driver_settings` hold what it does not know.
    OSError, RuntimeError
        If the driver cannot have the arm.
    """
    driver = ARMS.load(arm.driver)
    given = arm.driver_settings
    opened = driver(arm, given.checked(driver.settings_class, given.values), report)
    if not isinstance(getattr(opened, "keeps_limits", None), bool):
        opened.close()
        where = defined_in(driver)
        raise SettingError(f"arm driver '{arm.driver}': has no keeps_limits, must be True or False ({where})")
    return opened


def shortened(twist: Array, limits: ArmLimits) -> Array:
    """The twist (6,) with both speeds within limits, directions kept."""
    return _native.shortened(twist, limits.linear_velocity, limits.angular_velocity)
