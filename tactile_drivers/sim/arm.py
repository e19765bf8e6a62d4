"""SimArm: a robot arm that moves its sensor by velocity commands, within limits up to the jerk.

It stands for an arm with a velocity interface such as libfranka's: Ruckig turns each commanded twist into
the fastest motion that keeps the limits, the pose is the integral of the twist that results, and a watchdog
brings the arm to rest when commands stop coming::

    arm = SimArm(ArmSettings(), T_base_sensor, stamp_ns=0)
    arm.command(stamp_ns, twist)             # [v (m/s), omega (rad/s)] of the sensor, in the sensor frame
    T_base_sensor = arm.advance(0.01)        # seconds; arm.status says what the arm does and why
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import ruckig
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import Settings, setting
from tactile_filter import se3

Array = NDArray[np.float64]

NS = 1_000_000_000
_SAME_TWIST = 1e-9  # m/s and rad/s: below this, a twist is as commanded


class ArmMode(IntEnum):
    """What the arm does; the values are those of tactile_msgs/ArmStatus."""

    RESTING = 0
    MOVING = 1
    STOPPING = 2
    FAULT = 3


@dataclass(frozen=True)
class ArmSettings(Settings):
    """Limits of commands by their norms, and of velocity, acceleration and jerk on each axis of {s}.

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
        0.1, unit="s", lower=0.001, upper=10.0, doc="age of the last command at which the arm stops by itself"
    )


@dataclass(frozen=True)
class ArmStatus:
    """State of the arm at a stamp.

    Attributes
    ----------
    command_age : float
        Seconds since the stamp of the last accepted command; -1 before the first.
    limited : bool
        True while limits hold back the command.
    twist : ndarray (6,)
        Twist [v (m/s), omega (rad/s)] of the sensor, in the sensor frame.
    refused, clipped : int
        Commands that were not followed, and commands shortened to the velocity limit, since the start.
    last_refusal : str
        Why the last refused command was refused; empty if none was.
    """

    stamp_ns: int
    mode: ArmMode
    reason: str
    command_age: float
    limited: bool
    twist: Array
    refused: int
    clipped: int
    last_refusal: str


class SimArm:
    """An arm at a pose, with a twist; time is an integer stamp that only `advance` moves on.

    Parameters
    ----------
    settings : ArmSettings
    T_base_sensor : ndarray (4, 4)
        Where the sensor starts, at rest.
    stamp_ns : int
        Time at the start, ns.
    """

    def __init__(
        self, settings: ArmSettings | None = None, T_base_sensor: Array | None = None, stamp_ns: int = 0
    ) -> None:
        self.settings = settings or ArmSettings()
        self._stamp_ns = int(stamp_ns)
        self._pose = np.eye(4) if T_base_sensor is None else np.array(T_base_sensor, dtype=np.float64)
        self._twist = np.zeros(6)
        self._acceleration = np.zeros(6)
        self._target = np.zeros(6)
        self._clipped_now = False
        self._command_ns: int | None = None
        self._mode = ArmMode.RESTING
        self._reason = "no command yet"
        self._refused = self._clipped = 0
        self._last_refusal = ""
        self._generator = ruckig.Ruckig(6)
        self._trajectory = ruckig.Trajectory(6)
        self._input = _ruckig_input(self.settings)

    @property
    def stamp_ns(self) -> int:
        """Time of the arm's state, ns."""
        return self._stamp_ns

    @property
    def T_base_sensor(self) -> Array:
        """Pose (4, 4) of the sensor in the arm's base."""
        return self._pose.copy()

    @property
    def twist(self) -> Array:
        """Twist (6,) of the sensor, in the sensor frame."""
        return self._twist.copy()

    @property
    def mode(self) -> ArmMode:
        """What the arm does."""
        return self._mode

    @property
    def target(self) -> Array:
        """Twist (6,) that the arm moves towards, in the sensor frame; zero in a stop."""
        return self._target.copy()

    @property
    def status(self) -> ArmStatus:
        """What the arm does, and why."""
        return ArmStatus(
            stamp_ns=self._stamp_ns,
            mode=self._mode,
            reason=self._reason,
            command_age=self._command_age() if self._command_ns is not None else -1.0,
            limited=self._clipped_now or bool(np.abs(self._target - self._twist).max() > _SAME_TWIST),
            twist=self.twist,
            refused=self._refused,
            clipped=self._clipped,
            last_refusal=self._last_refusal,
        )

    def command(self, stamp_ns: int, twist: ArrayLike) -> bool:
        """Ask for a twist [v (m/s), omega (rad/s)] of the sensor, in the sensor frame, emitted at `stamp_ns`.

        Returns False, counts and gives the reason in `status.last_refusal` where the command is refused: not
        finite, not (6,), older than the one in force, already too old, or from further in the future than the
        command timeout. A twist above the velocity limits is shortened, keeping its direction, and counted.
        """
        wanted = np.asarray(twist, dtype=np.float64)
        refusal = self._refusal(int(stamp_ns), wanted)
        if refusal:
            self._refused += 1
            self._last_refusal = refusal
            return False
        self._command_ns = int(stamp_ns)
        self._target, self._clipped_now = _shortened(wanted, self.settings)
        self._clipped += self._clipped_now
        return True

    def fault(self, reason: str) -> None:
        """Stop and refuse commands until `clear_fault`."""
        self._mode, self._reason = ArmMode.FAULT, reason
        self._halt()

    def clear_fault(self) -> None:
        """Accept commands again; before a new one arrives the arm stays at rest."""
        if self._mode is ArmMode.FAULT:
            self._mode, self._reason = ArmMode.STOPPING, "fault cleared"
            self._command_ns = None

    def advance(self, dt: float) -> Array:
        """Move on by `dt` seconds and return T_base_sensor."""
        return self.advance_to(self._stamp_ns + round(dt * NS))

    def advance_to(self, stamp_ns: int) -> Array:
        """Move on to a stamp (ns) and return T_base_sensor; the watchdog looks where the step starts.

        Raises ValueError if the stamp lies before the arm's own.
        """
        if stamp_ns < self._stamp_ns:
            raise ValueError(f"stamp {stamp_ns} lies {self._stamp_ns - stamp_ns} ns before the arm's time")
        self._watch()
        if stamp_ns > self._stamp_ns:
            self._integrate((stamp_ns - self._stamp_ns) / NS)
        self._stamp_ns = int(stamp_ns)
        self._settle()
        return self.T_base_sensor

    def _command_age(self) -> float:
        return (self._stamp_ns - (self._command_ns or 0)) / NS

    def _refusal(self, stamp_ns: int, twist: Array) -> str:
        """Why the command cannot be followed; empty if it can."""
        if self._mode is ArmMode.FAULT:
            return f"the arm is in fault: {self._reason}"
        if twist.shape != (6,):
            return f"a twist has 6 elements, this one has shape {twist.shape}"
        if not np.isfinite(twist).all():
            return f"the twist is not finite: {twist.tolist()}"
        age, limit = (self._stamp_ns - stamp_ns) / NS, self.settings.command_timeout
        if abs(age) > limit:
            return f"the command is {age:.3f} s old (limit {limit:g} s, same into the future)"
        if self._command_ns is not None and stamp_ns < self._command_ns:
            return f"the command is {(self._command_ns - stamp_ns) / NS:.3f} s older than the one in force"
        return ""

    def _watch(self) -> None:
        """Decide what this step does: follow the command, or stop because it is too old."""
        if self._mode is ArmMode.FAULT or self._command_ns is None:
            return
        age, limit = self._command_age(), self.settings.command_timeout
        if age <= limit:
            self._mode, self._reason = ArmMode.MOVING, ""
        elif self._mode is ArmMode.MOVING:
            self._mode = ArmMode.STOPPING
            self._reason = f"no command for {age:.3f} s (limit {limit:g} s)"
            if self._last_refusal:
                self._reason += f"; last refused: {self._last_refusal}"
            self._halt()

    def _halt(self) -> None:
        self._target, self._clipped_now = np.zeros(6), False

    def _integrate(self, dt: float) -> None:
        """One Ruckig trajectory from the present twist and acceleration towards the target twist."""
        if not (self._twist.any() or self._target.any() or self._acceleration.any()):
            return
        self._input.current_velocity = self._twist
        self._input.current_acceleration = self._acceleration
        self._input.target_velocity = self._target
        result = self._generator.calculate(self._input, self._trajectory)
        if result < 0:
            raise RuntimeError(f"Ruckig found no trajectory from {self._twist} to {self._target}: {result}")
        moved, twist, acceleration = self._trajectory.at_time(dt)
        self._pose = _orthonormal(self._pose @ se3.exp(np.array(moved)))
        if dt >= self._trajectory.duration:  # there, exactly: rest is rest
            self._twist, self._acceleration = self._target.copy(), np.zeros(6)
        else:
            self._twist, self._acceleration = np.array(twist), np.array(acceleration)

    def _settle(self) -> None:
        """A stop that has come to its end is rest; so is a command of zero once it is reached."""
        still = not (self._twist.any() or self._acceleration.any() or self._target.any())
        if still and self._mode in (ArmMode.STOPPING, ArmMode.MOVING):
            self._mode = ArmMode.RESTING


def _ruckig_input(settings: ArmSettings) -> ruckig.InputParameter:
    """Velocity control with the displacement counted from zero in each step."""
    inputs = ruckig.InputParameter(6)
    inputs.control_interface = ruckig.ControlInterface.Velocity
    inputs.synchronization = ruckig.Synchronization.No
    inputs.current_position = [0.0] * 6
    inputs.target_acceleration = [0.0] * 6
    inputs.max_acceleration = [settings.linear_acceleration] * 3 + [settings.angular_acceleration] * 3
    inputs.max_jerk = [settings.linear_jerk] * 3 + [settings.angular_jerk] * 3
    return inputs


def _shortened(twist: Array, settings: ArmSettings) -> tuple[Array, bool]:
    """The twist with both speeds within limits, directions kept, and whether it changed."""
    out = twist.copy()
    for part, limit in ((slice(0, 3), settings.linear_velocity), (slice(3, 6), settings.angular_velocity)):
        norm = float(np.linalg.norm(out[part]))
        if norm > limit:
            out[part] *= limit / norm
    return out, bool((out != twist).any())


def _orthonormal(T: Array) -> Array:
    """T with the rotation drawn back onto SO(3), one Newton step of the polar decomposition."""
    R = T[:3, :3]
    T[:3, :3] = 1.5 * R - 0.5 * R @ (R.T @ R)
    return T
