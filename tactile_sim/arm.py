"""SimArm: a robot arm that moves its controlled frame by velocity commands, within limits up to the jerk.

It stands for an arm with a velocity interface such as libfranka's: each commanded twist becomes the fastest
motion that keeps the limits, the pose is the integral of the twist that results, and a watchdog of its own
brings the arm to rest when commands stop coming. What an arm should not be asked for is not its business but
that of the safe command stage before it (`tactile_drivers.safety`).

An arm with kinematics has joints besides, which follow the pose as those of a real one would; where they
cannot, it stops in fault::

    arm = SimArm(ArmLimits(), T_base_start, stamp_ns=0)
    arm.command(stamp_ns, twist)             # [v (m/s), omega (rad/s)] of the controlled frame, in that frame
    T_base_controlled = arm.advance(0.01)    # seconds; arm.state says what the arm does and why
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.stamps import SECOND_NS
from tactile_geometry import se3
from tactile_scene import _native
from tactile_scene.arm import ArmMode, ArmState
from tactile_scene.arm_settings import ArmLimits
from tactile_scene.kinematics.chain import Chain
from tactile_scene.twist_profile import TwistProfile

Array = NDArray[np.float64]


class SimArm:
    """An `Arm` at a pose, with a twist; time is an integer stamp that only `advance` moves on.

    Parameters
    ----------
    limits : ArmLimits
    T_base_controlled : ndarray (4, 4)
        Where the controlled frame starts, at rest.
    stamp_ns : int
        Time at the start, ns.
    kinematics : Chain, optional
        From the base to the controlled frame.

    Raises
    ------
    ValueError
        If the start is out of reach of the kinematics.
    """

    keeps_limits = True
    prompt = True

    def __init__(
        self,
        limits: ArmLimits | None = None,
        T_base_controlled: Array | None = None,
        stamp_ns: int = 0,
        kinematics: Chain | None = None,
    ) -> None:
        self.limits = limits or ArmLimits()
        self._stamp_ns = int(stamp_ns)
        start = np.eye(4) if T_base_controlled is None else np.array(T_base_controlled, dtype=np.float64)
        self._pose = _read_only(start)
        self.kinematics = kinematics
        self._joints = kinematics.reach(self._pose, kinematics.ready) if kinematics is not None else None
        self._motion = TwistProfile(self.limits)
        self._target = np.zeros(6)
        self._command_ns: int | None = None  # stamp of the command in force
        self._mode = ArmMode.RESTING
        self._reason = "no command yet"

    @property
    def stamp_ns(self) -> int:
        """Time of the arm's state, ns."""
        return self._stamp_ns

    @property
    def T_base_controlled(self) -> Array:
        """Pose (4, 4) of the controlled frame in the arm's base; not to be written to."""
        return self._pose

    @property
    def twist(self) -> Array:
        """Twist (6,) of the controlled frame, in that frame."""
        return self._motion.twist.copy()

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
        return ArmState(
            self._stamp_ns, self.T_base_controlled, self.twist, self._mode, self._reason, self._joints
        )

    def command(self, stamp_ns: int, twist: ArrayLike) -> None:
        """Follow a twist [v (m/s), omega (rad/s)] of the controlled frame, in it; not while in fault."""
        if self._mode is not ArmMode.FAULT:
            self._target, self._command_ns = np.array(twist, dtype=np.float64), int(stamp_ns)

    def stop(self, reason: str) -> None:
        """Come to rest within the limits; the next command moves the arm again."""
        if self._mode is ArmMode.FAULT or self._command_ns is None or self._silence():
            return
        self._mode, self._reason = ArmMode.STOPPING, reason
        self._halt()
        self._command_ns = None

    def close(self) -> None:
        """Stop; there is nothing to let go of."""
        self.stop("the driver was closed")

    def fault(self, reason: str) -> None:
        """Stop and follow nothing until `recover`."""
        self._mode, self._reason = ArmMode.FAULT, reason
        self._halt()

    def recover(self) -> None:
        """Leave a fault; before a new command arrives the arm stays at rest."""
        if self._mode is ArmMode.FAULT:
            self._mode, self._reason, self._command_ns = ArmMode.STOPPING, "fault cleared", None

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
        if self._mode is ArmMode.FAULT or self._command_ns is None:
            return
        silence = self._silence()
        if not silence:
            self._mode, self._reason = ArmMode.MOVING, ""
        elif self._mode is ArmMode.MOVING:
            self._mode, self._reason = ArmMode.STOPPING, silence
            self._halt()

    def _silence(self) -> str:
        """Why the command in force is too old to be followed; empty if it is not, or there is none."""
        if self._command_ns is None:
            return ""
        age, limit = (self._stamp_ns - self._command_ns) / SECOND_NS, self.limits.command_timeout
        return f"no command for {age:.3f} s (limit {limit:g} s)" if age > limit else ""

    def _halt(self) -> None:
        self._target = np.zeros(6)

    def _integrate(self, dt: float) -> None:
        """Move as the profile towards the target twist does."""
        moved = self._motion.advance(dt, self._target)
        if _native.is_moving(moved):
            self._pose = _read_only(se3.orthonormalized(se3.compose(self._pose, se3.exp(moved))))
            self._move_joints()

    def _move_joints(self) -> None:
        """Have the joints follow the pose; the arm comes to rest, in fault, where they cannot."""
        if self.kinematics is None or self._joints is None:
            return
        self._joints = self.kinematics.follow(self._joints, self._pose)
        beyond = self.kinematics.out_of_range(self._joints)
        if not beyond and not self.kinematics.follows(self._joints, self._pose):
            beyond = "the joints cannot follow, so near to a singularity"
        if beyond and self._mode is not ArmMode.FAULT:
            self.fault(beyond)

    def _settle(self) -> None:
        """A stop that has come to its end is rest; so is a command of zero once it is reached."""
        motion = self._motion
        still = not any(map(_native.is_moving, (motion.twist, motion.acceleration, self._target)))
        if still and self._mode in (ArmMode.STOPPING, ArmMode.MOVING):
            self._mode = ArmMode.RESTING


def _read_only(T: Array) -> Array:
    T.setflags(write=False)
    return T
