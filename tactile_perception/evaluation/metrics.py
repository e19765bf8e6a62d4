"""Predictions of networks for many samples at once, and their accuracy and calibration against labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm

from tactile_perception.evaluation.calibration import Calibration

Array = NDArray[np.float64]
#: Nominal levels of the central intervals whose coverage the tables give.
LEVELS = (0.50, 0.90, 0.95, 0.99)
#: Nominal levels of the reliability diagrams.
CURVE = np.linspace(0.0, 1.0, 41)
#: The paper's weights of the CNN's mean squared error (eq. mse_loss_def), by unit.
MSE_WEIGHTS = {"mm": 1.0, "rad": 100.0, "N": 0.0}


@dataclass(frozen=True)
class Predictions:
    """Gaussians over what the networks tell: xi_sf in the tangent space, or what another model has.

    Attributes
    ----------
    mean : (N, K) in mm, rad and N
    cov : (N, K, K), or None from a network without uncertainty
    """

    mean: Array
    cov: Array | None = None

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def sigma(self) -> Array:
        """Standard deviations (N, K)."""
        if self.cov is None:
            raise ValueError("predictions without uncertainty have no standard deviations")
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))

    def calibrated(self, calibration: Calibration) -> Predictions:
        """A copy with calibrated covariances."""
        if self.cov is None:
            raise ValueError("predictions without uncertainty cannot be calibrated")
        return Predictions(self.mean, calibration.covariance(self.mean, self.cov))

    def columns(self, chosen: Sequence[int]) -> Predictions:
        """Those of some quantities."""
        at = list(chosen)
        return Predictions(self.mean[:, at], None if self.cov is None else self.cov[:, at][:, :, at])

    def taken(self, chosen: NDArray[np.int64]) -> Predictions:
        """Those of some samples, in their order."""
        return Predictions(self.mean[chosen], None if self.cov is None else self.cov[chosen])


def moment_matched(members: Sequence[Predictions]) -> Predictions:
    """The Gaussian with mean and covariance of the equally weighted mixture of the members.

    Of members without uncertainty only the mean: their spread says nothing of the errors that they share.
    """
    means = np.stack([member.mean for member in members])
    mean = means.mean(axis=0)
    covs = [member.cov for member in members if member.cov is not None]
    if len(covs) < len(members):
        return Predictions(mean)
    spread = means - mean
    between = np.einsum("mni,mnj->nij", spread, spread) / len(members)
    return Predictions(mean, np.mean(covs, axis=0) + between)


@dataclass(frozen=True)
class Accuracy:
    """Errors of the means.

    Attributes
    ----------
    mse : the paper's weighted mean squared error, of the pose
    mae, rmse, bias : (K,) of xi_sf (of what is compared) in mm, rad and N; bias is prediction less label
    euler_mae : (6,) of the Euler surface contact pose in mm and degrees; NaN where it is not labelled
    """

    mse: float
    mae: Array
    rmse: Array
    bias: Array
    euler_mae: Array


@dataclass(frozen=True)
class Consistency:
    """How well the stated uncertainty fits the errors.

    Attributes
    ----------
    nll : mean negative log-likelihood (paper, eq. gdn_mean_nll_loss_def), in mm and rad
    nees : (K,) mean of (error / sigma)^2; 1 is right, more is overconfident
    nees_interval : in which 95 % of such means lie if the Gaussians are right
    joint, joint_interval : the same of the joint NEES / K
    coverage : (len(LEVELS), K) fraction of labels in the central intervals of LEVELS
    curve : (len(CURVE), K) the same at the levels of CURVE
    sharpness : (K,) mean predicted standard deviation in mm, rad and N
    """

    nll: float
    nees: Array
    nees_interval: tuple[float, float]
    joint: float
    joint_interval: tuple[float, float]
    coverage: Array
    curve: Array
    sharpness: Array


def accuracy(labels: Array, euler_error: Array, predictions: Predictions, units: Sequence[str]) -> Accuracy:
    """Errors of the means against labels (N, K) in these units; Euler errors (N, 6) in mm and degrees."""
    error = predictions.mean - labels
    weights = np.array([MSE_WEIGHTS[unit] for unit in units])
    return Accuracy(
        mse=float((error**2 @ weights).mean()),
        mae=np.abs(error).mean(axis=0),
        rmse=np.sqrt((error**2).mean(axis=0)),
        bias=error.mean(axis=0),
        euler_mae=np.abs(euler_error).mean(axis=0),
    )


def euler_error(euler_mm_deg: Array, found: Array) -> Array:
    """Found less label of the Euler surface contact pose, (N, 6) in mm and degrees."""
    error = found - euler_mm_deg
    error[:, 3:] = (error[:, 3:] + 180.0) % 360.0 - 180.0
    return error


def consistency(labels: Array, predictions: Predictions) -> Consistency:
    """Calibration of predictions that have covariances; `ValueError` for others."""
    if predictions.cov is None:
        raise ValueError("these predictions have no uncertainty: nothing can be said about its calibration")
    error = predictions.mean - labels
    squared = squared_mahalanobis(error, predictions.cov)
    _, log_det = np.linalg.slogdet(predictions.cov)
    z, size = np.abs(error) / predictions.sigma, error.shape[1]
    return Consistency(
        nll=float(0.5 * (squared + log_det + size * np.log(2.0 * np.pi)).mean()),
        nees=(z**2).mean(axis=0),
        nees_interval=mean_interval(len(z), 1),
        joint=float(squared.mean()) / size,
        joint_interval=mean_interval(len(z), size),
        coverage=coverage(z, np.array(LEVELS)),
        curve=coverage(z, CURVE),
        sharpness=predictions.sigma.mean(axis=0),
    )


def squared_mahalanobis(error: Array, cov: Array) -> Array:
    """error^T cov^-1 error of each row: (N, K), (N, K, K) -> (N,)."""
    return np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[:, :, None])[:, :, 0])


def coverage(z: Array, levels: Array) -> Array:
    """Fraction of |errors| in sigmas, (N, K), within each level's central interval: (len(levels), K)."""
    return np.stack([(z <= bound).mean(axis=0) for bound in norm.ppf(0.5 + 0.5 * levels)])


def mean_interval(count: int, dof: int, probability: float = 0.95) -> tuple[float, float]:
    """Interval of the mean over `count` samples of chi-square(dof) / dof."""
    total = count * dof
    low, high = chi2.ppf([0.5 - 0.5 * probability, 0.5 + 0.5 * probability], total) / total
    return float(low), float(high)


@dataclass(frozen=True)
class Bins:
    """Errors by another quantity.

    Attributes
    ----------
    edges : (B + 1,)
    count : (B,)
    mae, rmse : (B, K) in mm, rad and N; NaN where a bin is empty
    sigma : (B, K) root of the mean predicted variance; NaN without uncertainty
    nees : (B, K) mean of (error / sigma)^2
    """

    edges: Array
    count: NDArray[np.int64]
    mae: Array
    rmse: Array
    sigma: Array
    nees: Array


def binned(labels: Array, predictions: Predictions, by: Array, edges: Array) -> Bins:
    """Errors of the samples in each bin of the quantity `by` (N,); the last edge belongs to its bin."""
    error = predictions.mean - labels
    sigma = np.full_like(error, np.nan) if predictions.cov is None else predictions.sigma
    number = np.clip(np.searchsorted(edges, by, side="right") - 1, -1, len(edges) - 1)
    number[by == edges[-1]] = len(edges) - 2
    columns = (np.abs(error), error**2, sigma**2, (error / sigma) ** 2)
    means = np.full((4, len(edges) - 1, error.shape[1]), np.nan)
    count = np.bincount(number[(number >= 0) & (number < len(edges) - 1)], minlength=len(edges) - 1)
    for index in np.flatnonzero(count):
        means[:, index] = [column[number == index].mean(axis=0) for column in columns]
    mae, squared, variance, nees = means
    return Bins(edges, count, mae, np.sqrt(squared), np.sqrt(variance), nees)


def by_predicted_sigma(labels: Array, predictions: Predictions, bins: int = 10) -> list[Bins]:
    """For each component, its errors in bins of as many samples each of its predicted sigma."""
    found = []
    for component in range(labels.shape[1]):
        sigma = predictions.sigma[:, component]
        edges = np.unique(np.quantile(sigma, np.linspace(0.0, 1.0, bins + 1)))
        if len(edges) == 1:  # a network that always states the same
            edges = edges[0] * np.array([1.0 - 1e-6, 1.0 + 1e-6])
        found.append(binned(labels, predictions, sigma, edges))
    return found


def depth_edges(depth_mm: Array) -> Array:
    """Whole millimeters around the depths that occur, two at least."""
    least = np.floor(depth_mm.min())
    return np.arange(least, max(np.ceil(depth_mm.max()), least + 1.0) + 0.5)


def shear_of(euler_mm_deg: Array) -> Array:
    """Tangential displacement (N,) in mm."""
    return np.hypot(euler_mm_deg[:, 0], euler_mm_deg[:, 1])
