"""What the network's numbers mean: Euler surface contact pose -> X_fs -> X_sf -> xi_sf, its target, and back.

Public data gives the Euler surface contact pose (x, y, z, alpha, beta, gamma) of X_fs in millimeters and
degrees, extrinsic xyz. The network learns xi_sf = ln(X_sf) in millimeters and radians, so that its six
components have comparable sizes and read like the paper's tables. Everything else is SI. Its Gaussian over
xi_sf becomes the left-perturbation Gaussian over X_sf of the filter, and is read back from it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

Array = NDArray[np.float64]

#: SI per network unit, by component of xi = [rho, phi].
NETWORK_SCALE: Array = np.array([1e-3, 1e-3, 1e-3, 1.0, 1.0, 1.0])
NETWORK_SCALE.setflags(write=False)
COMPONENTS = ("rho_x", "rho_y", "rho_z", "phi_x", "phi_y", "phi_z")
NETWORK_UNITS = ("mm", "mm", "mm", "rad", "rad", "rad")
EULER_COMPONENTS = ("x", "y", "z", "alpha", "beta", "gamma")
EULER_UNITS = ("mm", "mm", "mm", "deg", "deg", "deg")
#: Component and unit, for titles, and for columns of files.
NETWORK_TITLES, EULER_TITLES, NETWORK_COLUMNS, EULER_COLUMNS = (
    tuple(form.format(*pair) for pair in zip(components, units, strict=True))
    for form in ("{} ({})", "{}_{}")
    for components, units in ((COMPONENTS, NETWORK_UNITS), (EULER_COMPONENTS, EULER_UNITS))
)


def errors_in_words(errors: Mapping[str, float], units: Mapping[str, str]) -> str:
    """Errors by the name of their component on a line; those that are not known (NaN) are left out."""
    groups: dict[tuple[str, str], list[str]] = {}
    for name, unit in units.items():
        if not math.isnan(errors.get(name, math.nan)):
            groups.setdefault((name.rpartition("_")[0], unit), []).append(name)
    texts = []
    for (prefix, unit), names in groups.items():
        digits = 4 if unit == "rad" else 3
        values = "/".join(f"{errors[name]:.{digits}f}" for name in names)
        listed = "/".join(name.rpartition("_")[2] for name in names)
        texts.append(f"{prefix} {listed} {values} {unit}".strip())
    return ", ".join(texts)


class EstimateError(ValueError):
    """An answer of the network that is no Gaussian: NaN, infinite, or without a positive (co)variance."""


def surface_contact_pose(euler_mm_deg: ArrayLike) -> Array:
    """T_fs (4, 4) in SI from (x, y, z, alpha, beta, gamma) in mm and degrees, extrinsic xyz."""
    euler = np.asarray(euler_mm_deg, dtype=np.float64)
    if euler.shape != (6,):
        raise ValueError(f"Euler surface contact pose: must have the shape (6,), has {euler.shape}")
    return se3.pose_from_euler(np.concatenate([euler[:3] * 1e-3, np.radians(euler[3:])]))


def euler_from_pose(T_fs: ArrayLike) -> Array:
    """(x, y, z, alpha, beta, gamma) in mm and degrees, extrinsic xyz, of T_fs (4, 4) in SI."""
    euler = se3.euler_from_pose(np.asarray(T_fs, dtype=np.float64))
    return np.concatenate([euler[:3] * 1e3, np.degrees(euler[3:])])


def label_from_euler(euler_mm_deg: ArrayLike) -> Array:
    """The network's target xi_sf (6,) in mm and rad for one Euler surface contact pose in mm and degrees."""
    return network_from_pose(se3.inverse(surface_contact_pose(euler_mm_deg)))


def labels_from_euler(euler_mm_deg: ArrayLike) -> Array:
    """`label_from_euler` for each row: (N, 6) -> (N, 6)."""
    rows = np.asarray(euler_mm_deg, dtype=np.float64).reshape(-1, 6)
    return np.array([label_from_euler(row) for row in rows]).reshape(-1, 6)


def euler_from_label(xi_network: ArrayLike) -> Array:
    """Euler surface contact pose in mm and degrees of a network vector xi_sf (6,) in mm and rad."""
    return euler_from_pose(se3.inverse(pose_from_network(xi_network)))


def depths(labels: ArrayLike) -> Array:
    """Depths (N,) in m, the z of X_fs, of network vectors xi_sf (N, 6) in mm and rad."""
    return 1e-3 * np.array([euler_from_label(label)[2] for label in np.asarray(labels)])


def network_from_pose(T_sf: ArrayLike) -> Array:
    """xi_sf (6,) in mm and rad of T_sf (4, 4) in SI."""
    return se3.log(np.asarray(T_sf, dtype=np.float64)) / NETWORK_SCALE


def pose_from_network(xi_network: ArrayLike) -> Array:
    """T_sf (4, 4) in SI of a network vector xi_sf (6,) in mm and rad."""
    return se3.exp(np.asarray(xi_network, dtype=np.float64) * NETWORK_SCALE)


def pose_gaussian(mean: Array, covariance: Array) -> PoseGaussian:
    """Network answer -> X_sf = exp(eps^) exp(mean^), eps ~ N(0, J(mean) Sigma J(mean)^T), in SI.

    Paper, eq. left_perturbation_cov: the network's Gaussian lives around its mean in the global tangent
    space; the left Jacobian carries it to the perturbation on the left of the mean.

    Raises `EstimateError` if the covariance is not positive definite.

    `mean` is xi_sf (6,) and `covariance` (6, 6), in mm and rad.
    """
    return gaussian_from_root(mean, covariance_root(covariance))


def covariance_root(covariance: Array) -> Array:
    """Lower triangular root of a network's covariance; `EstimateError` if it is not positive definite."""
    scale = np.sqrt(np.abs(np.diagonal(covariance)))
    try:
        # Of the correlations, so that units and sizes do not decide what is still positive.
        return np.asarray(scale[:, None] * np.linalg.cholesky(covariance / np.outer(scale, scale)))
    except np.linalg.LinAlgError as error:
        raise EstimateError(
            f"the network answered with a covariance that is not positive definite: {covariance}"
        ) from error


def gaussian_from_root(mean: Array, root: Array) -> PoseGaussian:
    """`pose_gaussian` with a root (6, 6) of the covariance, or the standard deviations (6,) of a diagonal."""
    xi = mean * NETWORK_SCALE
    jacobian = se3.left_jacobian(xi)
    if root.ndim == 1:
        root = jacobian * (NETWORK_SCALE * root)
    else:
        root = jacobian @ (NETWORK_SCALE[:, None] * root)
    return PoseGaussian(se3.exp(xi), root @ root.T)


def tangent_gaussian(gaussian: PoseGaussian) -> tuple[Array, Array]:
    """Mean (6,) and covariance (6, 6) of xi_sf in mm and rad of a left-perturbation Gaussian (SI).

    The reverse of the estimator's conversion: xi ~ N(mu, J^-1 Sigma J^-T), eq. glob_tangent_space_pdf.
    """
    xi = se3.log(gaussian.mean)
    inverse_jacobian = se3.inverse_left_jacobian(xi) / NETWORK_SCALE[:, None]
    return xi / NETWORK_SCALE, inverse_jacobian @ gaussian.cov @ inverse_jacobian.T
