"""The arithmetic of one step of the filter, on inputs that have been checked: prediction and innovation."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dtrtrs

from tactile_filter import se3

Array = NDArray[np.float64]

# A pose whose R^T R is off the identity by less (Frobenius norm) is as orthonormal as doubles are.
_ORTHONORMAL = 4e-15
_IDENTITY = np.eye(3)
_IDENTITY_ROW = np.array((0.0, 0.0, 0.0, 1.0))


class Innovation(NamedTuple):
    """How far a measurement is from the prediction.

    Attributes
    ----------
    nis : float
        Its squared Mahalanobis distance; infinite where the covariances allow none.
    whitened : (6,)
        Standard normal if both Gaussians are true; its squared length is `nis`.
    """

    nis: float
    whitened: Array


def predict(mean: Array, cov: Array, T_before: Array, T_now: Array, variances: Array) -> tuple[Array, Array]:
    """The algorithm's prediction: X <- T_k X, Sigma <- Ad(T_k) Sigma Ad(T_k)^T + Q, T_k = now^-1 before.

    Parameters
    ----------
    mean, cov : (4, 4) and (6, 6)
        Belief over X_sf before.
    T_before, T_now : (4, 4)
        Pose of the sensor then and now, in a frame in which the surface stands still.
    variances : (6,)
        Diagonal of the process noise's covariance.
    """
    T_k = between(T_now, T_before)
    adjoint = _adjoint(T_k)
    moved = adjoint @ cov @ adjoint.T
    moved += moved.T
    moved *= 0.5
    moved.ravel()[::7] += variances
    return renormalized(T_k @ mean), moved


def innovation(mean_obs: Array, cov_obs: Array, mean_bel: Array, cov_bel: Array) -> Innovation:
    """Innovation of a measurement against a prediction, both Gaussians over X_sf with left covariances.

    With X = exp(a^) X_obs = exp(b^) X_bel the innovation nu = log(X_obs X_bel^-1) obeys
    exp(nu^) = exp(-a^) exp(b^), so to first order in a and b about nu its covariance is
    S = J(nu)^-1 Sigma_obs J(nu)^-T + J(-nu)^-1 Sigma_bel J(-nu)^-T. Since J(-nu) = Ad(exp(-nu^)) J(nu) and
    J(nu) nu = nu, no Jacobian is needed: nu^T S^-1 nu = nu^T M^-1 nu with
    M = Sigma_obs + Ad(D) Sigma_bel Ad(D)^T, D = X_obs X_bel^-1.
    """
    D = np.empty((4, 4))
    D[:3, :3] = R = mean_obs[:3, :3] @ mean_bel[:3, :3].T
    D[:3, 3] = mean_obs[:3, 3] - R @ mean_bel[:3, 3]
    D[3] = _IDENTITY_ROW
    adjoint = _adjoint(D)
    factor, failed = dpotrf(cov_obs + adjoint @ cov_bel @ adjoint.T, lower=1)
    if failed:
        return Innovation(math.inf, np.full(6, math.inf))
    whitened, _ = dtrtrs(factor, se3.log(D), lower=1)
    nis = float(whitened @ whitened)
    return Innovation(nis if nis == nis else math.inf, whitened)


def between(T_a: Array, T_b: Array) -> Array:
    """T_a^-1 T_b (4, 4)."""
    result = np.empty((4, 4))
    transposed = T_a[:3, :3].T
    result[:3, :3] = transposed @ T_b[:3, :3]
    result[:3, 3] = transposed @ (T_b[:3, 3] - T_a[:3, 3])
    result[3] = _IDENTITY_ROW
    return result


def renormalized(T: Array) -> Array:
    """T, its rotation one step of Newton's method nearer to the nearest rotation; in place."""
    R = T[:3, :3]
    excess = R.T @ R
    excess -= _IDENTITY
    excess *= 0.5
    R -= R @ excess
    return T


def usable_pose(T: object) -> Array | None:
    """T as an orthonormal pose (4, 4), as it is if that is one to rounding; None if it is no pose at all."""
    pose = np.asarray(T, dtype=np.float64)
    if pose.shape == (4, 4):
        R = pose[:3, :3]
        excess = (R.T @ R - _IDENTITY).ravel()
        x, y, z = pose[:3, 3].tolist()
        near = float(excess @ excess) < _ORTHONORMAL**2 and math.isfinite(x + y + z)
        if near and pose[3].tolist() == [0.0, 0.0, 0.0, 1.0] and _determinant(R) > 0.0:
            return pose.copy()
    try:
        return se3.orthonormalized(pose)
    except ValueError:
        return None


def _determinant(R: Array) -> float:
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def _adjoint(T: Array) -> Array:
    """As se3.adjoint, of a pose known to be sound."""
    result = np.zeros((6, 6))
    R = T[:3, :3]
    result[:3, :3] = R
    result[3:, 3:] = R
    x, y, z = T[:3, 3].tolist()
    result[:3, 3:] = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))) @ R
    return result
