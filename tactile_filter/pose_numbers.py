"""Poses and Gaussians from the numbers of messages, checked, and back; without the messages themselves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tactile_filter import pose_covariance, se3
from tactile_filter.gaussian import PoseGaussian

Array = NDArray[np.float64]

QUATERNION_TOLERANCE = 1e-3  # how far from 1 the norm of a quaternion may be before it is refused


class MessageError(ValueError):
    """A message whose content cannot be used; the text says what it holds and what would be right."""


def matrix_from_quaternion(x: float, y: float, z: float, w: float) -> Array:
    """Rotation (3, 3) of a unit quaternion; small deviations of its norm are divided out.

    Raises
    ------
    MessageError
        If a component is not finite or the norm is off 1 by more than `QUATERNION_TOLERANCE`.
    """
    square = x * x + y * y + z * z + w * w
    if not abs(square - 1.0) <= 2.0 * QUATERNION_TOLERANCE:
        raise MessageError(f"quaternion (x, y, z, w) = ({x}, {y}, {z}, {w}): must have norm 1")
    return se3.rotation_from_quaternion((x, y, z, w))


def pose_from_numbers(translation: Sequence[float], rotation: Sequence[float]) -> Array:
    """T (4, 4) of a translation and a quaternion (x, y, z, w); raises `MessageError`."""
    x, y, z = translation
    return _matrix(x, y, z, matrix_from_quaternion(*rotation))


def numbers_from_pose(T: Array) -> tuple[float, ...]:
    """(x, y, z, qx, qy, qz, qw) of T (4, 4), as Pose and Transform have them."""
    return (*T[:3, 3].tolist(), *se3.quaternion_from_rotation(T[:3, :3]).tolist())


def gaussian_from_numbers(numbers: Sequence[float]) -> PoseGaussian:
    """Gaussian with left covariance of position, quaternion (x, y, z, w) and ROS covariance: 43 numbers.

    Raises
    ------
    MessageError
        If a number is not finite or a variance is negative.
    """
    mean = pose_from_numbers(numbers[:3], numbers[3:7])
    cov = np.array(numbers[7:], dtype=np.float64).reshape(6, 6)
    if not (np.isfinite(mean).all() and np.isfinite(cov).all()):
        raise MessageError("pose or covariance is not finite")
    if (np.diagonal(cov) < 0.0).any():
        raise MessageError(f"covariance has a negative variance: {np.diagonal(cov).tolist()}")
    return PoseGaussian(mean, pose_covariance.left_from_ros(cov, mean[:3, 3]))


def _matrix(x: float, y: float, z: float, R: Array) -> Array:
    T = np.empty((4, 4))
    T[:3, :3] = R
    T[:3, 3] = x, y, z
    T[3] = 0.0, 0.0, 0.0, 1.0
    return T
