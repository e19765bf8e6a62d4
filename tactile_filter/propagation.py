"""The filter's prediction, and how far a measurement is from it; both in C, half a microsecond a call."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_filter import _fusion

Array = NDArray[np.float64]


class Innovation(NamedTuple):
    """How far one Gaussian over poses is from another.

    Attributes
    ----------
    nis : its squared Mahalanobis distance; infinite where the covariances allow none
    whitened : (6,) standard normal if both Gaussians are true; its squared length is `nis`
    dof : degrees of freedom of `nis`
    """

    nis: float
    whitened: Array
    dof: int = 6


def predict(
    mean: ArrayLike, cov: ArrayLike, T_before: ArrayLike, T_now: ArrayLike, variances: ArrayLike
) -> tuple[Array, Array]:
    """The algorithm's prediction: X <- T_k X, Sigma <- Ad(T_k) Sigma Ad(T_k)^T + Q, T_k = now^-1 before.

    Rounding is taken out of the mean's rotation, and the covariance is exactly symmetric.
    Raises `ValueError` if an argument has the wrong shape, is not finite, or is no pose.

    Parameters
    ----------
    mean, cov : (4, 4) and (6, 6)
        Belief over X_sf before; left covariance, symmetric (its lower half is read).
    T_before, T_now : (4, 4) pose of the sensor then and now, in a frame in which the surface stands still
    variances : (6,) diagonal of the process noise's covariance
    """
    return _fusion.predict(mean, cov, T_before, T_now, variances)


def innovation(mean_1: ArrayLike, cov_1: ArrayLike, mean_2: ArrayLike, cov_2: ArrayLike) -> Innovation:
    """Innovation of a measurement (1) against a prediction (2), both with left covariances.

    With X = exp(a^) X_1 = exp(b^) X_2 the innovation nu = log(X_1 X_2^-1) obeys exp(nu^) = exp(-a^) exp(b^),
    so to first order in a and b about nu its covariance is
    S = J(nu)^-1 cov_1 J(nu)^-T + J(-nu)^-1 cov_2 J(-nu)^-T. Since J(-nu) = Ad(exp(-nu^)) J(nu) and
    J(nu) nu = nu, no Jacobian is needed: nu^T S^-1 nu = nu^T M^-1 nu with
    M = cov_1 + Ad(D) cov_2 Ad(D)^T, D = X_1 X_2^-1. M = L L^T whitens: L^-1 nu.

    Raises `ValueError` if an argument has the wrong shape or is not finite, or a mean is no pose matrix.
    """
    return Innovation(*_fusion.innovation(mean_1, cov_1, mean_2, cov_2))
