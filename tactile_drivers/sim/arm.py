"""SimArm: a robot arm that moves its controlled frame by velocity commands, within limits up to the jerk.

It stands for an arm with a velocity interface such as libfranka's: Ruckig turns each commanded twist into
the fastest motion that keeps the limits, the pose is the integral of the twist that results, and a watchdog
brings the arm to rest when commands stop coming::

    arm = SimArm(ArmLimits(), T_base_start, stamp_ns=0)
    arm.command(stamp_ns, twist)             # [v (m/s), omega (rad/s)] of the controlled frame, in that frame
    T_base_controlled = arm.advance(0.01)    # seconds; arm.state says what the arm does and why
"""

from __future__ import annotations

import numpy as np
import ruckig
from numpy.typing import ArrayLike, NDArray

from tactile_base.stamps import SECOND_NS
from tactile_drivers.arm import ArmLimits, ArmMode, ArmState, CommandGate
from tactile_filter import se3

Array = NDArray[np.float64]

_SAME_TWIST = 1e-9  # m/s and rad/s: below this, a twist is as commanded


class SimArm:
    """An arm at a pose, with a twist; time is an integer stamp that only `advance` moves on.

    Parameters
    ----------
    limits : ArmLimits
    T_base_controlled : ndarray (4, 4)
        Where the controlled frame starts, at rest.
    stamp_ns : int
        Time at the start, ns.
    """

    def __init__(
        self, limits: ArmLimits | None = None, T_base_controlled: Array | None = None, stamp_ns: int = 0
    ) -> None:
        self.limits = limits or ArmLimits()
        self._stamp_ns = int(stamp_ns)
        self._pose = np.eye(4) if T_base_controlled is None else np.array(T_base_controlled, dtype=np.float64)
        self._twist = np.zeros(6)
        self._acceleration = np.zeros(6)
        self._target = np.zeros(6)
        self._gate = CommandGate(self.limits)
        self._mode = ArmMode.RESTING
        self._reason = "no command yet"
        self._generator = ruckig.Ruckig(6)
        self._trajectory = ruckig.Trajectory(6)
        self._input = _ruckig_input(self.limits)

    @property
    def stamp_ns(self) -> int:
        """Time of the arm's state, ns."""
        return self._stamp_ns

    @property
    def T_base_controlled(self) -> Array:
        """Pose (4, 4) of the controlled frame in the arm's base."""
        return self._pose.copy()

    @property
    def twist(self) -> Array:
        """Twist (6,) of the controlled frame, in that frame."""
        return self._twist.copy()

    @property
    def mode(self) -> ArmMode:
        """What the arm does."""
        return self._mode

    @property
    def target(self) -> Array:
        """Twist (6,) that the arm moves towards, in the controlled frame; zero in a stop."""
        return self._target.copy()

    @property
    def state(self) -> ArmState:
        """Where the arm is, what it does, and why."""
        gate = self._gate
        return ArmState(
            stamp_ns=self._stamp_ns,
            T_base_controlled=self.T_base_controlled,
            twist=self.twist,
            mode=self._mode,
            reason=self._reason,
            command_age=gate.age(self._stamp_ns),
            limited=gate.clipped_now or bool(np.abs(self._target - self._twist).max() > _SAME_TWIST),
            refused=gate.refused,
            clipped=gate.clipped,
            last_refusal=gate.last_refusal,
        )

    def command(self, stamp_ns: int, twist: ArrayLike) -> bool:
        """Ask for a twist [v (m/s), omega (rad/s)] of the controlled frame, in that frame.

        Returns False and gives the reason in `state.last_refusal` where `CommandGate.admit` refuses it.
        """
        fault = self._reason if self._mode is ArmMode.FAULT else ""
        target = self._gate.admit(self._stamp_ns, stamp_ns, twist, fault)
        if target is None:
            return False
        self._target = target
        return True

    def stop(self, reason: str) -> None:
        """Come to rest within the limits; the next command moves the arm again."""
        gate = self._gate
        if self._mode is ArmMode.FAULT or gate.in_force_ns is None or gate.silence(self._stamp_ns):
            return
        self._mode, self._reason = ArmMode.STOPPING, reason
        gate.drop()
        self._halt()

    def close(self) -> None:
        """Stop; there is nothing to let go of."""
        self.stop("the driver was closed")

    def fault(self, reason: str) -> None:
        """Stop and refuse commands until `clear_fault`."""
        self._mode, self._reason = ArmMode.FAULT, reason
        self._halt()

    def clear_fault(self) -> None:
        """Accept commands again; before a new one arrives the arm stays at rest."""
        if self._mode is ArmMode.FAULT:
            self._mode, self._reason = ArmMode.STOPPING, "fault cleared"
            self._gate.drop()

    def advance(self, dt: float) -> Array:
        """Move on by `dt` seconds and return T_base_controlled."""
        return self.advance_to(self._stamp_ns + round(dt * SECOND_NS))

    def advance_to(self, stamp_ns: int) -> Array:
        """Move on to a stamp (ns) and return T_base_controlled; the watchdog looks where the step starts.

        Raises ValueError if the stamp lies before the arm's own.
        """
        if stamp_ns < self._stamp_ns:
            raise ValueError(f"stamp {stamp_ns} lies {self._stamp_ns - stamp_ns} ns before the arm's time")
        self._watch()
        if stamp_ns > self._stamp_ns:
            self._integrate((stamp_ns - self._stamp_ns) / SECOND_NS)
        self._stamp_ns = int(stamp_ns)
        self._settle()
        return self.T_base_controlled

    def _watch(self) -> None:
        """Decide what this step does: follow the command, or stop because it is too old."""
        if self._mode is ArmMode.FAULT or self._gate.in_force_ns is None:
            return
        silence = self._gate.silence(self._stamp_ns)
        if not silence:
            self._mode, self._reason = ArmMode.MOVING, ""
        elif self._mode is ArmMode.MOVING:
            self._mode, self._reason = ArmMode.STOPPING, silence
            self._halt()

    def _halt(self) -> None:
        self._target, self._gate.clipped_now = np.zeros(6), False

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


def _ruckig_input(limits: ArmLimits) -> ruckig.InputParameter:
    """Velocity control with the displacement counted from zero in each step."""
    inputs = ruckig.InputParameter(6)
    inputs.control_interface = ruckig.ControlInterface.Velocity
    inputs.synchronization = ruckig.Synchronization.No
    inputs.current_position = [0.0] * 6
    inputs.target_acceleration = [0.0] * 6
    inputs.max_acceleration = [limits.linear_acceleration] * 3 + [limits.angular_acceleration] * 3
    inputs.max_jerk = [limits.linear_jerk] * 3 + [limits.angular_jerk] * 3
    return inputs


def _orthonormal(T: Array) -> Array:
    """T with the rotation drawn back onto SO(3), one Newton step of the polar decomposition."""
    R = T[:3, :3]
    T[:3, :3] = 1.5 * R - 0.5 * R @ (R.T @ R)
    return T
