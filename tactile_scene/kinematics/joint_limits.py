"""How much of a twist the joints of an arm with known kinematics allow: ranges, speeds, singularities."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LENGTH = 0.1  # m; makes a rotation of the controlled frame comparable with a way, for singular values
PROBE = 1e-3  # rad; how far ahead a singularity is looked for


class Kinematics(Protocol):
    """Of an arm with n joints.

    Attributes
    ----------
    names : tuple of str (n,)
        Of the joints.
    lower, upper : ndarray (n,)
        Range of each joint, rad.
    velocity, acceleration : ndarray (n,)
        Largest of each joint, rad/s and rad/s^2.
    """

    names: tuple[str, ...]
    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array

    def pose(self, q: Array) -> Array:
        """Pose (4, 4) of the controlled frame in the base at joint angles (n,)."""

    def jacobian(self, q: Array) -> Array:
        """Jacobian (6, n) of the controlled frame's twist [v, omega], in that frame, at joint angles (n,)."""


def smallest_singular_value(kinematics: Kinematics, q: Array) -> float:
    """How far (m/rad) the slowest direction of the controlled frame moves with the joints; 0: it cannot."""
    scale = np.repeat([1.0, LENGTH], 3)[:, None]
    return float(np.linalg.svd(scale * kinematics.jacobian(q), compute_uv=False).min())


def joint_rates(kinematics: Kinematics, q: Array, twist: Array) -> Array:
    """The smallest speeds (n,) of the joints, rad/s, that make a twist (6,) at joint angles (n,)."""
    return np.asarray(np.linalg.lstsq(kinematics.jacobian(q), twist, rcond=None)[0])


def limited_rates(kinematics: Kinematics, q: Array, twist: Array) -> Array:
    """As `joint_rates`, all of them less by the same part where one would be faster than it may be."""
    rates = joint_rates(kinematics, q, twist)
    return rates / max(1.0, float((np.abs(rates) / kinematics.velocity).max()))


def allowed_part(
    kinematics: Kinematics, q: Array, rates: Array, delay: float, slow: float, stop: float
) -> tuple[float, str]:
    """The part 0..1 of their speeds (n,) that the joints at angles (n,) allow, and what makes it less.

    No joint is faster than it may be, or than it can brake before the end of its range, `delay` (s) from now.
    Towards a singularity the twist fades between the smallest singular values `slow` and `stop` (m/rad).
    """
    if not rates.any():
        return 1.0, ""
    a = kinematics.acceleration
    room = np.maximum(np.where(rates > 0.0, kinematics.upper - q, q - kinematics.lower), 0.0)
    bounds = np.minimum(kinematics.velocity, a * (np.sqrt(delay**2 + 2.0 * room / a) - delay))
    parts = np.divide(bounds, np.abs(rates), out=np.full_like(rates, np.inf), where=rates != 0.0)
    joint = int(parts.argmin())
    part, reason = (float(parts[joint]), f"joint {joint + 1}") if parts[joint] < 1.0 else (1.0, "")
    now = smallest_singular_value(kinematics, q)
    if now < slow and smallest_singular_value(kinematics, q + PROBE * rates / np.abs(rates).max()) < now:
        faded = max(0.0, (now - stop) / (slow - stop))
        if faded < part:
            return faded, "singularity"
    return part, reason
