"""Twists as matrices, for oracles by expm and logm."""

import numpy as np


def hat(xi: np.ndarray) -> np.ndarray:
    """Xi = [rho, phi] (6,) -> (4, 4)."""
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = [[0, -xi[5], xi[4]], [xi[5], 0, -xi[3]], [-xi[4], xi[3], 0]]
    matrix[:3, 3] = xi[:3]
    return matrix


def vee(matrix: np.ndarray) -> np.ndarray:
    """The reverse."""
    return np.array([*matrix[:3, 3], matrix[2, 1], matrix[0, 2], matrix[1, 0]])
