"""Predictions of a network for many samples at once, and what an ensemble makes of several networks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tactile_perception.estimating.labels import NETWORK_SCALE
from tactile_perception.evaluation.calibration import Calibration

Array = NDArray[np.float64]
OUTPUTS = 6


@dataclass(frozen=True)
class Predictions:
    """Gaussians over xi_sf in the tangent space.

    Attributes
    ----------
    mean : (N, 6) in mm and rad
    cov : (N, 6, 6) in mm and rad, or None from a network without uncertainty
    """

    mean: Array
    cov: Array | None = None

    @classmethod
    def from_inverse_sigma(cls, mean: Array, inverse_sigma: Array) -> Predictions:
        """With diagonal covariances from (N, 6) inverse standard deviations."""
        return cls(mean, inverse_sigma[:, :, None] ** -2 * np.eye(OUTPUTS))

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def sigma(self) -> Array:
        """Standard deviations (N, 6)."""
        if self.cov is None:
            raise ValueError("predictions without uncertainty have no standard deviations")
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))

    def calibrated(self, calibration: Calibration) -> Predictions:
        """The same means with calibrated covariances."""
        if self.cov is None:
            raise ValueError("predictions without uncertainty cannot be calibrated")
        return Predictions(self.mean, calibration.covariance(self.mean, self.cov))

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


def euler_of(mean: Array) -> Array:
    """Euler surface contact poses (N, 6) in mm and degrees of network vectors xi_sf (N, 6) in mm and rad.

    `labels.euler_from_label` for many at once.
    """
    xi = mean * NETWORK_SCALE
    rotation = Rotation.from_rotvec(xi[:, 3:])
    inverse = rotation.inv()
    position = -inverse.apply(_translation(xi))
    return np.hstack([position * 1e3, inverse.as_euler("xyz", degrees=True)])


def _translation(xi: Array) -> Array:
    """J(phi) rho for each row: the translation of exp(xi)."""
    rho, phi = xi[:, :3], xi[:, 3:]
    theta = np.linalg.norm(phi, axis=1)
    # sin(x)/x forms: (1 - cos t) / t^2 = (sin(t/2) / (t/2))^2 / 2 cancels nowhere.
    b = 0.5 * np.sinc(theta / (2.0 * np.pi)) ** 2
    small = theta < 1e-2
    safe = np.where(small, 1.0, theta)
    c = np.where(small, (1.0 - theta**2 / 20.0) / 6.0, (safe - np.sin(safe)) / safe**3)
    first = np.cross(phi, rho)
    return rho + b[:, None] * first + c[:, None] * np.cross(phi, first)
