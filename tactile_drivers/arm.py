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

from tactile_base.registry import Registry
from tactile_base.settings import Settings, setting
from tactile_base.stamps import SECOND_NS

if TYPE_CHECKING:
    from tactile_drivers.scene import ArmScene

Array = NDArray[np.float64]


class ArmMode(IntEnum):
    """What the arm does; the values are those of tactile_msgs/ArmStatus."""

    RESTING = 0
    MOVING = 1
    STOPPING = 2
    FAULT = 3


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


@dataclass(frozen=True)
class ArmState:
    """State of the arm at a stamp.

    Attributes
    ----------
    T_base_controlled : ndarray (4, 4)
        Pose of the controlled frame in the arm's base.
    twist : ndarray (6,)
        Twist [v (m/s), omega (rad/s)] of the controlled frame, in the controlled frame.
    reason : str
        Why the arm does what it does; empty in normal operation.
    command_age : float
        Seconds since the stamp of the command in force; -1 while there is none.
    limited : bool
        True while limits hold back the command.
    refused, clipped : int
        Commands that were not followed, and commands shortened to the velocity limit, since the start.
    last_refusal : str
        Why the last refused command was refused; empty if none was.
    """

    stamp_ns: int
    T_base_controlled: Array
    twist: Array
    mode: ArmMode
    reason: str = ""
    command_age: float = -1.0
    limited: bool = False
    refused: int = 0
    clipped: int = 0
    last_refusal: str = ""


class Arm(Protocol):
    """A driver that has been opened."""

    @property
    def state(self) -> ArmState | None:
        """The newest state; None before the first."""

    def command(self, stamp_ns: int, twist: ArrayLike) -> bool:
        """Ask for a twist (6,) of the controlled frame, in that frame, emitted at `stamp_ns`.

        Returns False, and gives the reason in `state.last_refusal`, where the command is refused;
        `CommandGate` holds what every driver refuses.
        """

    def stop(self, reason: str) -> None:
        """Bring the arm to rest within its limits; the next command moves it again."""

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
ARMS: Registry[ArmDriver] = Registry("arm driver", "tactile_servoing.arms", {})


def open_arm(arm: ArmScene, report: Callable[[ArmState], None]) -> Arm:
    """The arm of a scene, driven by the driver that the scene names.

    Raises
    ------
    SettingError
        If there is no such driver, or `driver_settings` hold something that it does not know.
    OSError, RuntimeError
        If the driver cannot have the arm.
    """
    driver = ARMS.load(arm.driver)
    given = arm.driver_settings
    return driver(arm, given.checked(driver.settings_class, given.values), report)


class CommandGate:
    """What every driver asks of a command before it follows it, and counts of those that it did not.

    Attributes
    ----------
    in_force_ns : int or None
        Stamp of the command in force.
    clipped_now : bool
        Whether that one was shortened to the velocity limits.
    refused, clipped, last_refusal
        As in `ArmState`.
    """

    def __init__(self, limits: ArmLimits) -> None:
        self.limits = limits
        self.in_force_ns: int | None = None
        self.clipped_now = False
        self.refused = self.clipped = 0
        self.last_refusal = ""

    def admit(self, now_ns: int, stamp_ns: int, twist: ArrayLike, fault: str = "") -> Array | None:
        """The twist (6,) to follow, shortened to the velocity limits in its direction; None: refused.

        Refused is a twist that is not finite or not (6,), one that is older than the one in force or than the
        command timeout, one from further in the future than that, and any while there is a `fault`.
        """
        wanted = np.asarray(twist, dtype=np.float64)
        refusal = self._refusal(now_ns, int(stamp_ns), wanted, fault)
        if refusal:
            self.refused += 1
            self.last_refusal = refusal
            return None
        self.in_force_ns = int(stamp_ns)
        shortened, self.clipped_now = _shortened(wanted, self.limits)
        self.clipped += self.clipped_now
        return shortened

    def drop(self) -> None:
        """There is no command in force any more."""
        self.in_force_ns, self.clipped_now = None, False

    def age(self, now_ns: int) -> float:
        """Age (s) of the command in force; -1 without one."""
        return (now_ns - self.in_force_ns) / SECOND_NS if self.in_force_ns is not None else -1.0

    def silence(self, now_ns: int) -> str:
        """Why the command in force is too old to be followed; empty if it is not, or there is none."""
        age, limit = self.age(now_ns), self.limits.command_timeout
        if age <= limit:
            return ""
        text = f"no command for {age:.3f} s (limit {limit:g} s)"
        return f"{text}; last refused: {self.last_refusal}" if self.last_refusal else text

    def _refusal(self, now_ns: int, stamp_ns: int, twist: Array, fault: str) -> str:
        """Why the command cannot be followed; empty if it can."""
        if fault:
            return f"the arm is in fault: {fault}"
        if twist.shape != (6,):
            return f"a twist has 6 elements, this one has shape {twist.shape}"
        if not np.isfinite(twist).all():
            return f"the twist is not finite: {twist.tolist()}"
        age, limit = (now_ns - stamp_ns) / SECOND_NS, self.limits.command_timeout
        if abs(age) > limit:
            return f"the command is {age:.3f} s old (limit {limit:g} s, same into the future)"
        if self.in_force_ns is not None and stamp_ns < self.in_force_ns:
            behind = (self.in_force_ns - stamp_ns) / SECOND_NS
            return f"the command is {behind:.3f} s older than the one in force"
        return ""


def _shortened(twist: Array, limits: ArmLimits) -> tuple[Array, bool]:
    """The twist with both speeds within limits, directions kept, and whether it changed."""
    out = twist.copy()
    for part, limit in ((slice(0, 3), limits.linear_velocity), (slice(3, 6), limits.angular_velocity)):
        norm = float(np.linalg.norm(out[part]))
        if norm > limit:
            out[part] *= limit / norm
    return out, bool((out != twist).any())
