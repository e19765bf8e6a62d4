"""Tactile servoing: from the believed surface contact pose to the twist that takes the sensor to a reference.

The paper's section "Tactile servoing controller". With the observed feature pose X_sf, the reference X_s'f,

    X_ss' = X_sf X_s'f^-1                        what is left to move, in the sensor frame
    u     = PID(log(X_ss')) + Ad(X_ss') v        v: reference velocity, in the reference frame {s'}

The twist is [v, omega] in the sensor frame {s}.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import Settings, setting
from tactile_control.pid import (
    FEEDBACK,
    SPACES,
    PidSettings,
    TangentPid,
    checked_vector,
    tangent_error,
    to_local,
)
from tactile_geometry import se3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ServoingSettings(Settings):
    """Reference and variant of the `ServoingController`; the gains are `PidSettings`."""

    reference: tuple[float, ...] = setting(
        [0.0, 0.0, 0.003, 0.0, 0.0, 0.0],
        length=6,
        lower=[-0.01, -0.01, 0.0, -0.8, -0.8, -0.8],
        upper=[0.01, 0.01, 0.01, 0.8, 0.8, 0.8],
        unit="m, rad",
        doc="feedback reference contact pose: Euler (x, y, z, alpha, beta, gamma) of X_fs'",
    )
    tangent_space: str = setting(
        "local", choices=SPACES, doc="tangent space of error and gains: local (the paper's) or global"
    )
    free_shear: bool = setting(
        False,
        doc="take x, y, gamma of the reference from the belief, so that shear neither turns the path nor "
        "leaks into depth through a tilt (off in the paper)",
    )


@dataclass(frozen=True)
class ServoingOutput:
    """One step of servoing.

    Attributes
    ----------
    twist : ndarray (6,)
        Feedback + feedforward, in {s}, m/s and rad/s.
    error : ndarray (6,)
        log(X_ss') in {s}, m and rad, whatever the tangent space of the gains.
    feedforward : ndarray (6,)
        Reference velocity mapped into {s} by Ad(X_ss').
    reference : ndarray (6,)
        The reference contact pose in force, Euler (x, y, z, alpha, beta, gamma) of X_fs', m and rad.
    """

    twist: Array
    error: Array
    feedforward: Array
    reference: Array


class ServoingController:
    """The paper's tactile servoing controller, in local or global tangent space."""

    def __init__(self, settings: ServoingSettings, pid: PidSettings) -> None:
        self.pid = TangentPid(pid)
        self.configure(settings, pid)

    def reset(self) -> None:
        """Forget the integral and the last error."""
        self.pid.reset()

    def configure(self, settings: ServoingSettings, pid: PidSettings) -> None:
        """Replace the settings between two steps; gains go over without a jump."""
        self.settings = settings
        euler = np.array(settings.reference)
        self._reference = euler, se3.pose_from_euler(euler)
        if pid != self.pid.settings:
            self.pid.configure(pid)

    def press(self, depth: float) -> None:
        """Take another depth (m) for that of the reference, until `configure`."""
        euler = self._reference[0].copy()
        euler[2] = depth
        self._reference = euler, se3.pose_from_euler(euler)

    def step(
        self, stamp_ns: int, X_sf: ArrayLike, velocity: ArrayLike = (0.0,) * 6, hold_integral: bool = False
    ) -> ServoingOutput:
        """Twist for a belief with mean X_sf (4, 4) exposed at `stamp_ns`.

        `velocity` (6,) is the reference velocity in the reference frame {s'}. Raises `se3.PoseError` for a
        pose that is not rigid, `ControlInputError` for a velocity that is not finite and for a stamp that is
        not later; nothing changes then.
        """
        X_fs = se3.inverse(se3.checked_pose("X_sf", X_sf))
        velocity = checked_vector("velocity", velocity)
        reference, X_reference = self.reference_for(X_fs)
        space = self.settings.tangent_space
        X_ss_ref = se3.between(X_fs, X_reference)
        error = se3.log(X_ss_ref)
        law_error = error if space == "local" else tangent_error(X_fs, X_reference, space)
        feedback = self.pid.update(stamp_ns, law_error, hold_integral)[FEEDBACK]
        feedforward = se3.carry(X_ss_ref, velocity)
        twist = to_local(feedback, X_fs, space) + feedforward
        return ServoingOutput(twist, error, feedforward, reference)

    def reference_for(self, X_fs: Array) -> tuple[Array, Array]:
        """The reference contact pose for an observed one (4, 4): Euler (6,), m and rad, and X_fs' (4, 4)."""
        if not self.settings.free_shear:
            return self._reference
        euler, observed = self._reference[0].copy(), se3.euler_from_pose(X_fs)
        euler[[0, 1, 5]] = observed[[0, 1, 5]]
        return euler, se3.pose_from_euler(euler)
