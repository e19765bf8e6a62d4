"""SE(3): exponential and logarithm, adjoint, left Jacobian and its inverse, interpolation, conversions.

A pose is a homogeneous matrix ``T`` (4, 4), a tangent vector ``xi = [rho, phi]`` (6,) with the translation
first and the rotation in radians (the paper's "Notation and mathematical preliminaries", after Barfoot).
Nothing here knows units of length. Conversions from and to Euler angles and quaternions also take stacks,
with leading dimensions, and convert each to the bit as alone.

exp, log, adjoint and the Jacobians are in C (`_csrc/se3_exact.h`): worked out with twice the precision and
rounded once, so that they are correct to about the last digit from angle 0 to pi, the Jacobians to 2 pi.
`test/geometry/se3_reference.py` has the same in NumPy, to be read.

Raises
------
ValueError
    From every function: an argument of the wrong shape or with an element that is not finite.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_geometry import _se3

Array = NDArray[np.float64]
Vector = Sequence[float]
Rows = Sequence[Vector]
Shape = tuple[int, ...]

ROTATION_TOLERANCE = 1e-6  # largest element of R^T R - I for R to count as a rotation


class PoseError(ValueError):
    """What should be a pose is none; the text says what it is of, and what is wrong with it."""


def exp(xi: ArrayLike) -> Array:
    """Pose (4, 4) = exp(xi^) of a tangent vector (6,), in closed form (paper's exponential map)."""
    return _se3.exp(xi)


def log(T: ArrayLike) -> Array:
    """Tangent vector (6,) of a pose (4, 4), with |phi| <= pi (paper's logarithmic map).

    At exactly pi, where phi and -phi are the same rotation, the first non-zero component of phi is positive.
    A rotation that is off by more than rounding, and by no more than `ROTATION_TOLERANCE`, counts as the
    nearest one; that it is no further off is not checked.
    """
    return _se3.log(T)


def inverse(T: ArrayLike) -> Array:
    """Inverse of a pose (4, 4), from the transpose of its rotation."""
    return _se3.inverse(T)


def compose(A: ArrayLike, B: ArrayLike) -> Array:
    """Product A B (4, 4) of two poses; a third of the time that `A @ B` takes."""
    return _se3.compose(A, B)


def between(A: ArrayLike, B: ArrayLike) -> Array:
    """Pose A^-1 B (4, 4) of B in the frame that A leads to."""
    return _se3.between(A, B)


def adjoint(T: ArrayLike) -> Array:
    """Ad(T) (6, 6) = [[C, r^ C], [0, C]], so that exp((Ad(T) xi)^) = T exp(xi^) T^-1 (paper's adjoint)."""
    return _se3.adjoint(T)


def carry(T: ArrayLike, xi: ArrayLike) -> Array:
    """Ad(T) xi (6,): a twist or tangent vector (6,) of the frame that T leads to, in the frame it is in."""
    return _se3.carry(T, xi)


def point_in(T: ArrayLike, point: ArrayLike) -> Array:
    """A point (3,) in the coordinates (3,) of the frame that T (4, 4) leads to."""
    return _se3.point_in(T, point)


def left_jacobian(xi: ArrayLike) -> Array:
    """Left Jacobian J (6, 6): exp((xi + d)^) = exp((J d)^) exp(xi^) to first order in d. Closed form."""
    return _se3.left_jacobian(xi)


def inverse_left_jacobian(xi: ArrayLike) -> Array:
    """Inverse (6, 6) of the left Jacobian, in closed form; not at |phi| = 2 pi n, n > 0.

    With ad the curly hat of xi it equals I - ad/2 + (e + theta^2 d) ad^2 + d ad^4, where
    e = (1 - (theta/2) cot(theta/2)) / theta^2 and d = -(de/dtheta) / (2 theta).
    """
    return _se3.inverse_left_jacobian(xi)


def interpolate(T0: ArrayLike, T1: ArrayLike, s: float) -> Array:
    """Pose (4, 4) at the fraction s of the screw motion from T0 to T1; exactly T0 at 0 and T1 at 1."""
    return _se3.interpolate(T0, T1, s)


def orthonormalized(T: ArrayLike) -> Array:
    """The pose (4, 4) with its rotation replaced by the nearest one (to rounding).

    Raises `ValueError` if the upper left block is further than `ROTATION_TOLERANCE` from a rotation.
    """
    return _se3.orthonormalized(T)


def norm(vector: Array) -> float:
    """Euclidean norm of a vector: to the bit that of `numpy.linalg.norm`, which takes ten times as long."""
    return math.sqrt(vector.dot(vector))


def checked_pose(name: str, value: ArrayLike) -> Array:
    """The value as a (4, 4) float array; `PoseError` with the name where it is no finite rigid transform."""
    T = np.asarray(value, dtype=np.float64)
    if _se3.is_pose(T):
        return T
    if T.shape != (4, 4):
        raise PoseError(f"{name}: shape {T.shape}, must be (4, 4)")
    if not np.isfinite(T).all():
        raise PoseError(f"{name} is not finite: {T.tolist()}")
    R = T[:3, :3]
    error = float(np.abs(R @ R.T - np.eye(3)).max())
    if error > ROTATION_TOLERANCE or np.linalg.det(R) < 0.0 or T[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise PoseError(
            f"{name} is not a rigid transform (orthogonality error {error:.2g}, must be right-handed, "
            f"last row [0, 0, 0, 1]): {T.tolist()}"
        )
    return T


def usable_pose(T: object) -> Array | None:
    """T as an orthonormal pose (4, 4), as it is if one to rounding; None if it is none, or is 1e9 m away."""
    return _se3.usable_pose(T)


def pose_from_euler(pose6: ArrayLike) -> Array:
    """Poses (..., 4, 4) of (x, y, z, alpha, beta, gamma) (..., 6): turns (rad) about fixed x, y, z in turn.

    This is 'sxyz' of transforms3d and 'xyz' of SciPy: R = Rz(gamma) Ry(beta) Rx(alpha).
    """
    return _se3.pose_from_euler(pose6)


def euler_from_pose(T: ArrayLike) -> Array:
    """(x, y, z, alpha, beta, gamma) (..., 6) of poses (..., 4, 4), |beta| <= pi/2; inverts `pose_from_euler`.

    At |beta| = pi/2, where only alpha and gamma together are defined, gamma is 0.
    """
    return _se3.euler_from_pose(T)


def quaternion_from_rotation(R: ArrayLike) -> Array:
    """Unit quaternions (..., 4) as (x, y, z, w) of rotations (..., 3, 3), w >= 0 (Shepperd's method).

    At w = 0 the first non-zero component is positive.
    """
    return _each(_quaternion_from_rotation, R, (3, 3), (4,), "R")


def _quaternion_from_rotation(first: Vector, second: Vector, third: Vector) -> Vector:
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = first, second, third
    trace = r00 + r11 + r22
    largest = max(trace, r00, r11, r22)
    if largest == trace:
        q = (r21 - r12, r02 - r20, r10 - r01, 1.0 + trace)
    elif largest == r00:
        q = (1.0 + r00 - r11 - r22, r01 + r10, r02 + r20, r21 - r12)
    elif largest == r11:
        q = (r01 + r10, 1.0 - r00 + r11 - r22, r12 + r21, r02 - r20)
    else:
        q = (r02 + r20, r12 + r21, 1.0 - r00 - r11 + r22, r10 - r01)
    norm = math.hypot(*q)
    if norm == 0.0:
        raise ValueError("R: is not a rotation")
    leading = q[3] or next(component for component in q if component)
    scale = math.copysign(1.0 / norm, leading)
    return tuple(component * scale + 0.0 for component in q)


def rotation_from_quaternion(quaternion: ArrayLike) -> Array:
    """Rotations (..., 3, 3) of quaternions (x, y, z, w) (..., 4) of any non-zero norm."""
    array = _stacked(quaternion, (4,), "quaternion")
    rows = array.reshape(-1, 4)
    norms = [math.hypot(*row) for row in rows.tolist()]
    if not all(norms):
        raise ValueError("quaternion: is zero, must have norm 1")
    # plain numbers where there is one: NumPy takes longer for these
    x, y, z, w = rows.T / norms if array.ndim > 1 else [c / norms[0] for c in array.tolist()]
    R = np.array((
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
        (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
    ))  # fmt: skip
    return R if array.ndim == 1 else R.transpose(2, 0, 1).copy().reshape(*array.shape[:-1], 3, 3)


def _each(convert: Callable[..., Any], value: ArrayLike, shape: Shape, result: Shape, name: str) -> Array:
    """One array of a shape converted, or each in a stack: by the same operations, so that bits agree."""
    array = _stacked(value, shape, name)
    if array.ndim == len(shape):
        return np.array(convert(*array.tolist()))
    found = [convert(*each) for each in array.reshape(-1, *shape).tolist()]
    return np.array(found, dtype=np.float64).reshape(array.shape[: -len(shape)] + result)


def _stacked(value: ArrayLike, shape: Shape, name: str) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.shape[-len(shape) :] != shape:
        raise ValueError(f"{name}: must have shape {shape}, or that behind others, has {array.shape}")
    return _finite(array, name)


def _finite(array: Array, name: str) -> Array:
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: must be finite, is {array.tolist()}")
    return array
