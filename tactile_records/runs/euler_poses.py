"""Many contact poses as Euler poses (x, y, z, alpha, beta, gamma), which people read, with deviations."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_geometry import se3
from tactile_records.runs.record import GaussianSeries

Array = NDArray[Any]

COMPONENT_NAMES = {  # component: what it is, and its unit
    "x": ("shear x", "mm"),
    "y": ("shear y", "mm"),
    "z": ("depth z", "mm"),
    "alpha": ("angle α", "deg"),
    "beta": ("angle β", "deg"),
    "gamma": ("shear γ", "deg"),
}
COMPONENTS = tuple(COMPONENT_NAMES)
UNIT_NAMES = tuple(unit for _, unit in COMPONENT_NAMES.values())
UNITS = np.array([1e3, 1e3, 1e3, *(180.0 / np.pi,) * 3])  # of the components: mm, deg


def inverses(T: Array) -> Array:
    """Inverses (N, 4, 4) of rigid transforms."""
    result = np.zeros_like(T)
    result[:, :3, :3] = T[:, :3, :3].transpose(0, 2, 1)
    result[:, :3, 3] = -np.einsum("nij,nj->ni", result[:, :3, :3], T[:, :3, 3])
    result[:, 3, 3] = 1.0
    return result


def component(name: str) -> tuple[int, float, str]:
    """Of a component its column, the factor to its unit, and what it is, with the unit, for an axis."""
    column, (what, unit) = COMPONENTS.index(name), COMPONENT_NAMES[name]
    return column, float(UNITS[column]), f"{what} [{unit}]"


def euler_poses(T: Array) -> Array:
    """Euler contact poses (N, 6) of (N, 4, 4), m and rad; NaN where the pose is."""
    result, known = np.full((len(T), 6), np.nan), np.isfinite(T).all(axis=(1, 2))
    result[known] = se3.euler_from_pose(T[known])
    return result


def euler_sigmas(series: GaussianSeries) -> Array:
    """Standard deviations (N, 6) of the Euler contact pose of X_fs = X_sf^-1, to first order.

    With X_fs = mean^-1 exp(-eps^), the position moves by -R_fs rho, and the orientation by the rotation
    -R_fs phi in {f}; extrinsic xyz Euler angles turn about z, about y turned by gamma, and about x turned by
    both.
    """
    X_fs = inverses(series.mean)
    R, R_T = X_fs[:, :3, :3], X_fs[:, :3, :3].transpose(0, 2, 1)
    position, rotation = R @ series.cov[:, :3, :3] @ R_T, R @ series.cov[:, 3:, 3:] @ R_T
    rates = np.linalg.inv(_rotation_of_euler_rates(euler_poses(X_fs)))
    angles = rates @ rotation @ rates.transpose(0, 2, 1)
    variances = [np.diagonal(cov, axis1=1, axis2=2) for cov in (position, angles)]
    return np.sqrt(np.concatenate(variances, axis=1))


def _rotation_of_euler_rates(euler: Array) -> Array:
    """Columns (N, 3, 3): the axes in {f} about which alpha, beta and gamma turn."""
    beta, gamma = euler[:, 4], euler[:, 5]
    axes = np.zeros((len(euler), 3, 3))
    axes[:, 0, 0], axes[:, 0, 1] = np.cos(beta) * np.cos(gamma), -np.sin(gamma)
    axes[:, 1, 0], axes[:, 1, 1] = np.cos(beta) * np.sin(gamma), np.cos(gamma)
    axes[:, 2, 0], axes[:, 2, 2] = -np.sin(beta), 1.0
    return axes
