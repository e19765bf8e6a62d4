"""Poses and speeds as arms' controllers tell them: rotation vectors, the tool's speed in the base."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_geometry import se3

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


def controlled_twist(T_base_controlled: Array, T_tool_controlled: Array, speed: Array) -> Array:
    """The twist of the controlled frame, in it, of a tool with that speed (6,) in the base."""
    R = T_base_controlled[:3, :3]
    lever = R @ T_tool_controlled[:3, :3].T @ T_tool_controlled[:3, 3]  # from the tool, in the base
    return np.concatenate([R.T @ (speed[:3] + np.cross(speed[3:], lever)), R.T @ speed[3:]])


def tool_speed(T_base_controlled: Array, T_tool_controlled: Array, twist: Array) -> Array:
    """The speed (6,) of the tool, in the base, with which the controlled frame has a twist (6,) in itself."""
    R = T_base_controlled[:3, :3]
    turn = R @ twist[3:]
    lever = R @ se3.inverse(T_tool_controlled)[:3, 3]  # from the controlled frame to the tool
    return np.concatenate([R @ twist[:3] + np.cross(turn, lever), turn])
