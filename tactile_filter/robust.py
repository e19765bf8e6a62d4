"""Robust corrections: the covariance of an estimate that is unlikely is inflated before it is fused.

With the innovation nu between measurement (covariance R) and prediction (covariance P, both in the
measurement's tangent space), the generalized eigenvectors that make R the identity and P diag(lambda) turn
nu into z, and the linear correction with inflated covariance kappa R leaves

    residual_i = kappa z_i / (lambda_i + kappa),     variance_i = kappa lambda_i / (lambda_i + kappa),

so that the inflation is a fixed point in one number:

- ``student_t``: the estimate's error is Student t with nu degrees of freedom and covariance R, that is, it is
  normal with covariance kappa R where kappa is inverse gamma. Variational Bayes for both has
  kappa = (nu - 2 + E[residual^T R^-1 residual]) / (nu + 6). It is below 1 for estimates that agree:
  if the tails are heavy, the middle is narrower than the covariance says.
- ``huber``: the cost of a residual grows with its Mahalanobis distance d instead of its square beyond a
  threshold k: kappa = max(1, d / k). Estimates that agree are fused as they are.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dsygv

from tactile_filter.fusion import FusionError
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

Array = NDArray[np.float64]

DOF = 6
_ACCURACY = 1e-6  # of the inflation; a millionth of it moves nothing
_STEPS = 1000  # rarely more than 20; near a double fixed point the way to it is slow


class Spectrum:
    """An innovation in the basis in which the measurement's covariance is the identity.

    `FusionError` if the two covariances have no such basis in double precision.

    Parameters
    ----------
    measurement : PoseGaussian
    mean, cov : (4, 4) and (6, 6), the prediction

    Attributes
    ----------
    squares : z^2 along the generalized eigenvectors; floats, since NumPy takes longer for so few
    ratio : the prediction's variances along these, lambda
    """

    def __init__(self, measurement: PoseGaussian, mean: Array, cov: Array) -> None:
        D = measurement.mean @ se3.inverse(mean)
        adjoint = se3.adjoint(D)
        ratio, vectors, failed = dsygv(adjoint @ cov @ adjoint.T, measurement.cov, uplo="L")
        if failed:
            raise FusionError("the covariances of measurement and prediction have no common basis")
        self.ratio: list[float] = np.maximum(ratio, 0.0).tolist()
        self.squares: list[float] = ((se3.log(D) @ vectors) ** 2).tolist()

    def residual_squared(self, kappa: float) -> float:
        """Squared Mahalanobis distance, by R, of what the correction leaves of the innovation."""
        total = 0.0
        for square, ratio in zip(self.squares, self.ratio, strict=True):
            total += square * (kappa / (ratio + kappa)) ** 2
        return total

    def expected_squared(self, kappa: float) -> float:
        """Expectation of `residual_squared` over the posterior: with the trace of its covariance by R."""
        total = 0.0
        for square, ratio in zip(self.squares, self.ratio, strict=True):
            share = kappa / (ratio + kappa)
            total += share * (share * square + ratio)
        return total


def student_t_inflation(spectrum: Spectrum, dof: float) -> float:
    """Factor on the measurement's covariance if its errors are Student t with `dof` > 2.

    Raises FusionError where it is infinite.

    From the right-hand side's largest value down: the largest fixed point, and so the most cautious one
    where an estimate is far enough off to allow two.
    """
    kappa = (dof - 2.0 + sum(spectrum.squares) + sum(spectrum.ratio)) / (dof + DOF)
    for _ in range(_STEPS):
        last = kappa
        kappa = (dof - 2.0 + spectrum.expected_squared(kappa)) / (dof + DOF)
        if last - kappa <= _ACCURACY * last:
            break
    return _finite(kappa)


def huber_inflation(spectrum: Spectrum, threshold: float) -> float:
    """Factor on the measurement's covariance for a cost that is linear beyond `threshold`.

    Raises FusionError where it is infinite.

    The threshold is a Mahalanobis distance in 6 dimensions; the factor is the kappa of at least 1 with
    d(kappa) = kappa * threshold.
    """
    if spectrum.residual_squared(1.0) <= threshold**2:
        return 1.0
    # d(kappa) / kappa falls from above the threshold at 1 to below it at |z| / threshold
    low, high = 1.0, math.sqrt(sum(spectrum.squares)) / threshold
    while high - low > _ACCURACY * high:
        middle = 0.5 * (low + high)
        if not low < middle < high:
            break
        if spectrum.residual_squared(middle) > (middle * threshold) ** 2:
            low = middle
        else:
            high = middle
    return _finite(0.5 * (low + high))


def _finite(kappa: float) -> float:
    if not math.isfinite(kappa):
        raise FusionError("the innovation is too large for double precision")
    return kappa
