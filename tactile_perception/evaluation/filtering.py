"""The paper's filter experiment: a data set in random order as a sequence of motions known up to noise.

Paper, "Error and uncertainty reduction using a Bayesian filter": the motion between two contacts follows from
their labels, T_k = exp(psi^) X_k X_{k-1}^-1 with psi ~ N(0, Sigma_psi), and the filter assumes the noise
Sigma_phi. Public tables are sorted by depth; here the order is random.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from tactile_filter.bayes_filter import ContactFilter, FilterSettings
from tactile_filter.fusion import fuse
from tactile_filter.propagation import predict
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian
from tactile_perception.datasets.layout import DatasetError
from tactile_perception.estimating.contact_model import POSE
from tactile_perception.estimating.labels import pose_gaussian, surface_contact_pose, tangent_gaussian
from tactile_perception.estimating.sources import Frame
from tactile_perception.evaluation.evaluate import EvaluationData
from tactile_perception.evaluation.metrics import Predictions, squared_mahalanobis

Array = NDArray[np.float64]
_PERIOD_NS = 100_000_000
#: Where the process noise is searched, in mm and degrees.
_NOISE_RANGE = (1e-3, 30.0)


def motion_covariance(sigma: float) -> Array:
    """Covariance (6, 6) in SI of a motion's noise of `sigma` mm and `sigma` degrees.

    Paper, eq. se3_filter_exp_state_trans_cov.
    """
    return np.diag(np.repeat([sigma * 1e-3, np.radians(sigma)], 3) ** 2)


def motion_filter(sigma: float, settings: FilterSettings | None = None) -> ContactFilter:
    """The paper's filter for motions known up to `sigma` mm and degrees: it fuses every measurement.

    `settings` give the rest; without them nothing is gated, as in the paper.
    """
    settings = settings or FilterSettings(gate_probability=1.0)
    noise = {"process_noise_translation": sigma * 1e-3, "process_noise_rotation": float(np.radians(sigma))}
    return ContactFilter(settings.replaced(**noise))


def with_motion_noise(frames: Iterable[Frame], sigma: float, seed: int) -> Iterator[Frame]:
    """The frames with the poses that noisy odometry would give; frames without a pose pass as they are."""
    drift = Drift(sigma, seed)
    for frame in frames:
        true = frame.T_base_sensor
        yield frame if true is None else replace(frame, T_base_sensor=drift(true))


class Drift:
    """Poses of the sensor as noisy odometry gives them, one after the other: T_k = exp(psi^) X_k X_{k-1}^-1.

    Paper, eq. se3_filter_exp_state_trans_model.
    """

    def __init__(self, sigma: float, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._deviation = np.sqrt(np.diag(motion_covariance(sigma)))
        self._true: Array | None = None
        self._drifted = np.eye(4)

    def __call__(self, true: Array) -> Array:
        """The drifted pose (4, 4) that goes with the next true one."""
        if self._true is None:
            self._drifted = true
        else:
            noise = se3.exp(self._rng.normal(0.0, self._deviation))
            motion = noise @ se3.inverse(true) @ self._true
            self._drifted = se3.orthonormalized(self._drifted @ se3.inverse(motion))
        self._true = true
        return self._drifted


@dataclass(frozen=True)
class ContactSequence:
    """Contacts one after the other, with the motion between them known up to noise.

    Attributes
    ----------
    order : (N,) samples of the data set
    labels : (N, 6) xi_sf in mm and rad, in that order
    T_surface_sensor : (N, 4, 4) poses of the sensor as noisy odometry gives them
    """

    order: NDArray[np.int64]
    labels: Array
    T_surface_sensor: Array


@dataclass(frozen=True)
class FilterRun:
    """Filtered estimates of a sequence.

    Attributes
    ----------
    mean, sigma : (N, 6) of xi_sf in mm and rad, in the sequence's order
    mae : (6,) in mm and rad
    nees : joint NEES / 6 of the beliefs
    nis : mean normalized innovation squared / 6
    """

    mean: Array
    sigma: Array
    mae: Array
    nees: float
    nis: float


def contact_sequence(data: EvaluationData, sigma_psi: float, seed: int) -> ContactSequence:
    """The data set in random order with motions of noise `sigma_psi` (mm and degrees)."""
    order = np.random.default_rng(seed).permutation(len(data))
    drift = Drift(sigma_psi, seed)
    if not data.model.tangent or data.compared[:POSE] != tuple(range(POSE)):
        raise DatasetError(
            f"{data.folder}: the filter's experiment needs labels of all six components, as sensor's poses, "
            f"and networks of a surface, not of '{data.model.name}'"
        )
    poses = [drift(surface_contact_pose(euler)) for euler in data.euler_mm_deg[order]]
    return ContactSequence(order, data.labels[order, :POSE], np.array(poses))


def pose_gaussians(predictions: Predictions) -> list[PoseGaussian]:
    """X_sf as left-perturbation Gaussians in SI (paper, eq. left_perturbation_cov)."""
    if predictions.cov is None:
        raise ValueError("a network without uncertainty has nothing that a filter could weigh")
    pairs = zip(predictions.mean[:, :POSE], predictions.cov[:, :POSE, :POSE], strict=True)
    return [pose_gaussian(mean, cov) for mean, cov in pairs]


def unfiltered(sequence: ContactSequence, predictions: Predictions) -> FilterRun:
    """The sequence without a filter: sigma_psi = infinity."""
    taken = predictions.columns(range(POSE)).taken(sequence.order)
    return _scored(sequence, taken, math.nan)


def run_filter(
    sequence: ContactSequence,
    measurements: Sequence[PoseGaussian],
    sigma_phi: float,
    settings: FilterSettings | None = None,
) -> FilterRun:
    """Filter a sequence.

    Parameters
    ----------
    measurements : Gaussians over X_sf of all samples of the data set, in the data set's order
    sigma_phi : noise of the motion that the filter assumes, in mm and degrees
    settings : everything else; default: the paper's, without a gate
    """
    contact_filter = motion_filter(sigma_phi, settings)
    means, covs, nis = [], [], []
    for k, (index, pose) in enumerate(zip(sequence.order, sequence.T_surface_sensor, strict=True)):
        belief = contact_filter.step(k * _PERIOD_NS, measurements[index], pose)
        if not belief.valid:
            raise ValueError(f"the filter has no belief at step {k}: {belief.reason}")
        mean, cov = tangent_gaussian(PoseGaussian(belief.mean, belief.cov))
        means.append(mean)
        covs.append(cov)
        nis.append(belief.nis)
    known = [value for value in nis if not math.isnan(value)]  # the first step has none
    mean_nis = float(np.mean(known)) / 6.0 if known else math.nan
    return _scored(sequence, Predictions(np.array(means), np.array(covs)), mean_nis)


def _scored(sequence: ContactSequence, filtered: Predictions, nis: float) -> FilterRun:
    assert filtered.cov is not None
    error = filtered.mean - sequence.labels
    nees = float(squared_mahalanobis(error, filtered.cov).mean()) / 6.0
    return FilterRun(filtered.mean, filtered.sigma, np.abs(error).mean(axis=0), nees, nis)


def estimate_process_noise(sequence: ContactSequence, measurements: Sequence[PoseGaussian]) -> float:
    """The sigma_phi (mm and degrees) under which the filter's innovations are most likely.

    It needs no labels but those that stand in for the arm's odometry. Arguments as for `run_filter`.
    """
    low, high = np.log(_NOISE_RANGE)
    found = minimize_scalar(
        lambda log_sigma: -innovation_log_likelihood(sequence, measurements, float(np.exp(log_sigma))),
        bounds=(low, high),
        method="bounded",
        options={"xatol": 0.02},
    )
    return float(np.exp(found.x))


def innovation_log_likelihood(
    sequence: ContactSequence, measurements: Sequence[PoseGaussian], sigma_phi: float
) -> float:
    """Log-likelihood of the measurements, each given those before it, up to a constant.

    The innovation nu = log(X_obs X_bel^-1) has the covariance Sigma_obs + Ad(D) Sigma_bel Ad(D)^T with
    D = exp(nu^), in the tangent space of the measurement.
    """
    variances = np.diag(motion_covariance(sigma_phi))
    first = measurements[sequence.order[0]]
    mean, cov, total = first.mean, first.cov, 0.0
    poses = sequence.T_surface_sensor
    for k in range(1, len(sequence.order)):
        measured = measurements[sequence.order[k]]
        mean, cov = predict(mean, cov, poses[k - 1], poses[k], variances)
        D = measured.mean @ se3.inverse(mean)
        adjoint = se3.adjoint(D)
        factor = np.linalg.cholesky(measured.cov + adjoint @ cov @ adjoint.T)
        whitened = np.linalg.solve(factor, se3.log(D))
        total -= 0.5 * float(whitened @ whitened) + float(np.log(np.diag(factor)).sum())
        fused = fuse(measured.mean, measured.cov, mean, cov, "fast")
        mean, cov = fused.mean, fused.cov
    return total
