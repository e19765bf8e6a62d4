"""Poses and Gaussians of many messages at once: to the bit what `pose_numbers` makes of each."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_filter.pose_numbers import QUATERNION_TOLERANCE

Array = NDArray[Any]


def sound_poses(numbers: Array) -> Array:
    """Which poses (N, 7), position and quaternion (x, y, z, w), are ones: finite, with a norm of 1."""
    x, y, z, w = numbers[:, 3:].T
    square = x * x + y * y + z * z + w * w
    return np.isfinite(numbers).all(axis=1) & (np.abs(square - 1.0) <= 2.0 * QUATERNION_TOLERANCE)


def poses_from_numbers(numbers: Array) -> Array:
    """T (N, 4, 4) of sound poses (N, 7)."""
    norms = np.array([math.hypot(*quaternion) for quaternion in numbers[:, 3:].tolist()])
    x, y, z, w = (numbers[:, 3:] / norms.reshape(-1, 1)).T
    T = np.zeros((len(numbers), 4, 4))
    T[:, 0, :3] = np.stack((1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)), -1)
    T[:, 1, :3] = np.stack((2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)), -1)
    T[:, 2, :3] = np.stack((2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)), -1)
    T[:, :3, 3] = numbers[:, :3]
    T[:, 3, 3] = 1.0
    return T


def left_from_ros(covs: Array, positions: Array) -> Array:
    """Left covariances (N, 6, 6) from those of ROS poses at positions (N, 3)."""
    return _transformed(covs, positions)


def ros_from_left(covs: Array, positions: Array) -> Array:
    """Covariances (N, 6, 6) of ROS poses at positions (N, 3) from left ones."""
    return _transformed(covs, -1.0 * positions)


def _transformed(covs: Array, positions: Array) -> Array:
    x, y, z = positions.T
    A = np.tile(np.eye(6), (len(covs), 1, 1))
    A[:, 0, 4], A[:, 0, 5] = -z, y
    A[:, 1, 3], A[:, 1, 5] = z, -x
    A[:, 2, 3], A[:, 2, 4] = -y, x
    result = A @ covs @ A.transpose(0, 2, 1)
    return 0.5 * (result + result.transpose(0, 2, 1))
