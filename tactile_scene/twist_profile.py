"""TwistProfile: the fastest way from one twist to another within limits of acceleration and jerk."""

from __future__ import annotations

import atexit
import weakref

import numpy as np
import ruckig
from numpy.typing import ArrayLike, NDArray

from tactile_scene.arm_settings import ArmLimits

Array = NDArray[np.float64]


class TwistProfile:
    """Goes towards target twists, each axis by itself; the arithmetic is Ruckig's.

    Attributes
    ----------
    twist, acceleration : ndarray (6,)
        Now, m/s and rad/s, m/s^2 and rad/s^2.
    """

    def __init__(self, limits: ArmLimits) -> None:
        self._ruckig: tuple[ruckig.Ruckig, ruckig.InputParameter, ruckig.Trajectory] | None
        self._ruckig = ruckig.Ruckig(6), _ruckig_input(limits), ruckig.Trajectory(6)
        _LIVING.add(self)
        self.start(np.zeros(6))

    def start(self, twist: ArrayLike) -> None:
        """Begin at a steady twist (6,)."""
        self.twist, self.acceleration = np.array(twist, dtype=np.float64), np.zeros(6)

    def advance(self, dt: float, target: Array) -> Array:
        """Go towards the target twist (6,) for `dt` seconds; returns the way (6,) meanwhile, m and rad.

        Raises
        ------
        RuntimeError
            If Ruckig finds no way.
        """
        if self._ruckig is None or not (self.twist.any() or target.any() or self.acceleration.any()):
            return np.zeros(6)
        generator, inputs, trajectory = self._ruckig
        inputs.current_velocity, inputs.current_acceleration = self.twist, self.acceleration
        inputs.target_velocity = target
        result = generator.calculate(inputs, trajectory)
        if result < 0:
            raise RuntimeError(f"Ruckig found no trajectory from {self.twist} to {target}: {result}")
        moved, twist, acceleration = trajectory.at_time(dt)
        if dt >= trajectory.duration:  # there, exactly: rest is rest
            self.twist, self.acceleration = target.copy(), np.zeros(6)
        else:
            self.twist, self.acceleration = np.array(twist), np.array(acceleration)
        return np.array(moved)

    def release(self) -> None:
        """Let go of Ruckig's objects; it goes nowhere from now on."""
        self._ruckig = None


_LIVING: weakref.WeakSet[TwistProfile] = weakref.WeakSet()


@atexit.register
def _release_all() -> None:
    """Before the interpreter ends: Ruckig tells of each object that outlives it, a page at the end of a log.

    Threads that never end keep them, and what C holds on to, as rclpy does to callbacks of nodes.
    """
    for profile in list(_LIVING):
        profile.release()


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
