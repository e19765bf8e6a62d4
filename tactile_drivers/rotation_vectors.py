"""Poses as Universal Robots' controllers tell them: a position and a rotation vector."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_filter import se3

Array = NDArray[np.float64]


def pose_of(vector: ArrayLike) -> Array:
    """The pose (4, 4) of a position (m) and a rotation vector (rad), (6,)."""
    numbers = np.asarray(vector, dtype=np.float64)
    T = se3.exp(np.concatenate([np.zeros(3), numbers[3:]]))
    T[:3, 3] = numbers[:3]
    return T


def vector_of(T: Array) -> Array:
    """Position (m) and rotation vector (rad), (6,), of a pose (4, 4)."""
    R = np.eye(4)
    R[:3, :3] = T[:3, :3]
    return np.concatenate([T[:3, 3], se3.log(R)[3:]])
