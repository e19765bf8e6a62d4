"""Poses and Gaussians <-> the numbers of ROS messages, checked; without the messages themselves.

A pose is 7 numbers, position and quaternion (x, y, z, w); a Gaussian is these and the 36 of its covariance as
ROS means it. Everything takes one of them, or stacks of them with leading dimensions, and answers to the bit
the same for each: live nodes convert one at a time, a replay a recording at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_geometry import se3
from tactile_geometry.gaussian import UNUSABLE, PoseGaussian, left_from_ros
from tactile_wire.errors import MessageError

Array = NDArray[np.float64]

QUATERNION_TOLERANCE = 1e-3  # how far from 1 the norm of a quaternion may be before it is refused


def are_poses(numbers: ArrayLike) -> NDArray[np.bool_]:
    """Which of the poses (..., 7) are ones: finite, and with a quaternion of norm 1."""
    array = np.asarray(numbers, dtype=np.float64)
    return np.isfinite(array).all(axis=-1) & _have_norm_1(array[..., 3:])


def pose_from_numbers(numbers: ArrayLike) -> Array:
    """T (..., 4, 4) of poses (..., 7); small deviations of a quaternion's norm are divided out.

    Raises `MessageError` if a number is not finite, or a quaternion's norm is off 1 by more than
    `QUATERNION_TOLERANCE`.
    """
    array = np.asarray(numbers, dtype=np.float64)
    usable = are_poses(array)
    if not usable.all():
        raise MessageError(_pose_fault(array[~usable][0]))
    T = np.zeros((*array.shape[:-1], 4, 4))
    T[..., :3, :3] = se3.rotation_from_quaternion(array[..., 3:])
    T[..., :3, 3], T[..., 3, 3] = array[..., :3], 1.0
    return T


def numbers_from_pose(T: ArrayLike) -> Array:
    """Numbers (..., 7) of T (..., 4, 4), as Pose and Transform have them."""
    pose = np.asarray(T, dtype=np.float64)
    quaternion = se3.quaternion_from_rotation(pose[..., :3, :3])
    return np.concatenate((pose[..., :3, 3], quaternion), axis=-1)


def gaussian_from_numbers(numbers: Sequence[float]) -> PoseGaussian:
    """Gaussian with left covariance of 43 numbers.

    Raises `MessageError` if a number is not finite, the quaternion's norm is not 1, or a variance is
    negative.
    """
    array = np.array(numbers, dtype=np.float64)
    mean, cov = pose_from_numbers(array[:7]), array[7:].reshape(6, 6)
    if not _are_covariances(cov):
        lack = "has a negative variance" if np.isfinite(cov).all() else "is not finite"
        raise MessageError(f"covariance {lack}; its diagonal is {np.diag(cov).tolist()}")
    return PoseGaussian(mean, left_from_ros(cov, mean[:3, 3]))


def gaussians_from_numbers(numbers: ArrayLike) -> list[PoseGaussian]:
    """Gaussians of (N, 43) numbers; UNUSABLE for those that `gaussian_from_numbers` refuses."""
    array = np.asarray(numbers, dtype=np.float64)
    poses, covs = array[:, :7], array[:, 7:].reshape(-1, 6, 6)
    rows = np.flatnonzero(are_poses(poses) & _are_covariances(covs))
    means, left = pose_from_numbers(poses[rows]), left_from_ros(covs[rows], poses[rows, :3])
    result = [UNUSABLE] * len(array)
    for row, mean, cov in zip(rows.tolist(), means, left, strict=True):
        result[row] = PoseGaussian(mean, cov)
    return result


def _have_norm_1(quaternions: Array) -> Any:
    return np.abs((quaternions * quaternions).sum(axis=-1) - 1.0) <= 2.0 * QUATERNION_TOLERANCE


def _are_covariances(covs: Array) -> Any:
    variances = np.diagonal(covs, axis1=-2, axis2=-1)
    return np.isfinite(covs).all(axis=(-2, -1)) & (variances >= 0.0).all(axis=-1)


def _pose_fault(numbers: Array) -> str:
    x, y, z, *quaternion = numbers.tolist()
    if not _have_norm_1(numbers[3:]):
        return f"quaternion (x, y, z, w) = {tuple(quaternion)}: must have norm 1"
    return f"position ({x}, {y}, {z}) is not finite"
