"""Post-hoc calibration: a network's standard deviations scaled to the errors it makes on data held out.

A network that overfits its training data takes itself to be more exact than it is. Calibration
leaves the means alone and multiplies the standard deviation of component j by

    exp(h_j(ln sigma_j) + g_j(mu_z)),

h_j and g_j piecewise linear between knots. The negative log-likelihood is convex in the values at the knots,
and where it is smallest each component's NEES on the fitted data is 1. Optionally the errors' correlation
is added, and, as a margin and a floor, what the samples of one session cannot show. Data that the network was
trained on, or that chose its best epoch, calibrate nothing: hold back.
"""

from __future__ import annotations

import dataclasses
import json
import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.input_file import parse_json
from tactile_base.settings import Settings, setting
from tactile_perception.estimating.labels import COMPONENTS

Array = NDArray[np.float64]

FORMAT = "tactile_servoing.calibration/1"
OUTPUTS = 6
#: Component of xi_sf that is (minus) the depth.
DEPTH = COMPONENTS.index("rho_z")
_NEWTON_STEPS = 50


class CalibrationError(ValueError):
    """Data from which nothing can be calibrated, or a stored calibration that cannot be used."""


@dataclass(frozen=True)
class CalibrationSettings(Settings):
    """How much freedom a calibration has."""

    sigma_knots: int = setting(
        5, lower=1, upper=50, doc="knots over the predicted deviation; 1: one factor for all deviations"
    )
    depth_knots: int = setting(1, lower=1, upper=50, doc="knots over the predicted depth; 1: no dependence")
    correlation: bool = setting(False, doc="also add the correlation of the errors")
    stiffness: float = setting(
        20.0,
        lower=0.0,
        upper=1e6,
        doc="weight, in samples, that holds the logarithms of neighboring knots' factors together",
    )
    margin: tuple[float, ...] = setting(
        (1.0,) * OUTPUTS,
        lower=0.1,
        upper=10.0,
        length=OUTPUTS,
        doc="further factors on the deviations, for what samples of one session cannot show: friction, "
        "the sensor's seat and the surface's place are others next time",
    )
    floor: tuple[float, ...] = setting(
        (0.0,) * OUTPUTS,
        lower=0.0,
        upper=[10.0] * 3 + [1.0] * 3,
        length=OUTPUTS,
        unit="mm, rad",
        doc="standard deviations of what is constant through a session and unknown, added in quadrature",
    )
    min_samples: int = setting(100, lower=20, upper=1_000_000, doc="refuse to fit fewer samples than this")


@dataclass(frozen=True)
class Calibration:
    """Factors on predicted standard deviations; without arguments the identity.

    Attributes
    ----------
    sigma_knots, sigma_values : (K, knots) natural logarithms of deviations (mm, rad) and of the factors there
    depth_knots : (D,) predicted rho_z in mm
    depth_values : (K, D) logarithms of the factors there, on top of the others
    correlation : (K, K) of the errors, or () to leave the network's own
    floor : (K,) standard deviations in mm, rad and N, added in quadrature after the factors
    samples : number of samples it was fitted on; 0 for the identity
    nees_error : standard error of the joint NEES / 6 that so many samples leave
    """

    sigma_knots: tuple[tuple[float, ...], ...] = ((0.0,),) * OUTPUTS
    sigma_values: tuple[tuple[float, ...], ...] = ((0.0,),) * OUTPUTS
    depth_knots: tuple[float, ...] = (0.0,)
    depth_values: tuple[tuple[float, ...], ...] = ((0.0,),) * OUTPUTS
    correlation: tuple[tuple[float, ...], ...] = ()
    floor: tuple[float, ...] = (0.0,) * OUTPUTS
    samples: int = 0
    nees_error: float = 0.0

    def __post_init__(self) -> None:
        for name in ("sigma_knots", "sigma_values", "depth_knots", "depth_values", "correlation", "floor"):
            object.__setattr__(self, name, _finite_tuple(name, getattr(self, name)))
        for name in ("sigma_values", "depth_values", "floor"):
            if len(getattr(self, name)) != self.size:
                raise CalibrationError(f"{name}: must be {self.size} numbers, as sigma_knots has rows")
        for k, pair in enumerate(zip(self.sigma_knots, self.sigma_values, strict=True)):
            _check_knots(f"component {k + 1}", *pair)
            _check_knots(f"component {k + 1}", self.depth_knots, self.depth_values[k])
        if min(self.floor) < 0.0:
            raise CalibrationError(f"floor: must be numbers that are not negative, is {self.floor}")
        if self.correlation:
            _check_correlation(np.array(self.correlation), self.size)

    @property
    def size(self) -> int:
        """Number of quantities that it is of; the identity fits any."""
        return len(self.sigma_knots)

    @cached_property
    def is_identity(self) -> bool:
        """Whether it changes nothing."""
        rows = (*self.sigma_values, *self.depth_values, self.floor)
        return not self.correlation and not any(map(any, rows))

    def factors(self, mean: ArrayLike, sigma: ArrayLike) -> Array:
        """Factors on standard deviations: mean and sigma (K,) or (N, K) in mm, rad, N -> the same shape."""
        mean, sigma = np.asarray(mean, np.float64), np.asarray(sigma, np.float64)
        if mean.ndim == 1:
            return self._factors_of_one(float(mean[DEPTH]), sigma.tolist())
        log_sigma, depth = np.log(sigma), mean[..., DEPTH]
        logs = [
            np.interp(log_sigma[..., j], self.sigma_knots[j], self.sigma_values[j])
            + np.interp(depth, self.depth_knots, self.depth_values[j])
            for j in range(self.size)
        ]
        return np.hypot(np.exp(np.stack(logs, axis=-1)), np.array(self.floor) / sigma)

    def _factors_of_one(self, depth: float, sigma: list[float]) -> Array:
        """Factors (K,) of one image, without NumPy, whose calls cost more than they compute."""
        return np.array(
            [
                math.hypot(
                    math.exp(
                        _interpolated(math.log(sigma[j]), self.sigma_knots[j], self.sigma_values[j])
                        + _interpolated(depth, self.depth_knots, self.depth_values[j])
                    ),
                    self.floor[j] / sigma[j],
                )
                for j in range(self.size)
            ]
        )

    def covariance(self, mean: ArrayLike, cov: ArrayLike) -> Array:
        """Calibrated covariance around mu (mm, rad, N): (..., K, K) -> the same shape."""
        cov = np.asarray(cov, np.float64)
        if self.is_identity:
            return cov
        sigma = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
        factors = self.factors(mean, sigma)
        if self.correlation:
            scaled = factors * sigma
            return np.array(self.correlation) * scaled[..., :, None] * scaled[..., None, :]
        return cov * factors[..., :, None] * factors[..., None, :]

    def to_json(self) -> str:
        """As text for a model's metadata."""
        return json.dumps({"format": FORMAT, **dataclasses.asdict(self)})

    @classmethod
    def from_json(cls, text: str) -> Calibration:
        """The reverse; `CalibrationError` says what is wrong with the text."""
        try:
            values: Any = parse_json(text)
        except ValueError as error:
            raise CalibrationError(f"calibration: is not JSON: {error}") from error
        found = values.pop("format", None) if isinstance(values, dict) else None
        if found != FORMAT:
            raise CalibrationError(f"calibration: format is {found!r}, must be {FORMAT!r}")
        try:
            return cls(**values)
        except (TypeError, ValueError) as error:
            raise CalibrationError(f"calibration: {error}") from error


def _interpolated(x: float, knots: Sequence[float], values: Sequence[float]) -> float:
    """`np.interp` of one number."""
    right = bisect_right(knots, x)
    if right == 0:
        return values[0]
    if right == len(knots):
        return values[-1]
    left = right - 1
    part = (x - knots[left]) / (knots[right] - knots[left])
    return values[left] + part * (values[right] - values[left])


def fit_calibration(
    labels: ArrayLike,
    mean: ArrayLike,
    cov: ArrayLike,
    settings: CalibrationSettings | None = None,
    error: ArrayLike | None = None,
) -> Calibration:
    """Fit the factors to a network's errors on data that it was not trained on.

    `CalibrationError` for fewer than `settings.min_samples` rows, arrays that do not fit together, or values
    that are not finite. What has no labels (NaN) is left as it is; floor and margin are of the pose alone.

    Parameters
    ----------
    labels, mean : (N, K) what the network is to say (xi_sf) and its predictions, in mm, rad and N
    cov : (N, K, K) predicted covariances, or (N, K) predicted standard deviations (not inverse ones)
    error : (N, K) mean - labels, where that is not the plain difference
    """
    settings = settings or CalibrationSettings()
    labels, mean, cov = (np.asarray(value, np.float64) for value in (labels, mean, cov))
    sigma = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1)) if cov.ndim == 3 else cov
    _check_data(labels, mean, sigma, settings)
    error = labels - mean if error is None else np.asarray(error, np.float64)
    log_sigma, squared, known = np.log(sigma), (error / sigma) ** 2, np.isfinite(labels)
    extra = labels.shape[1] - OUTPUTS
    margin, floor = (*settings.margin, *(1.0,) * extra), (*settings.floor, *(0.0,) * extra)
    depth_knots = _knots(mean[:, DEPTH], settings.depth_knots)
    depth_basis = _hats(mean[:, DEPTH], depth_knots)
    sigma_knots, sigma_values, depth_values = [], [], []
    for j in range(labels.shape[1]):
        rows = known[:, j]
        if rows.sum() < settings.min_samples:
            sigma_knots.append(np.zeros(1))
            sigma_values.append(np.zeros(1))
            depth_values.append(np.zeros(len(depth_knots)))
            continue
        knots = _knots(log_sigma[rows, j], settings.sigma_knots)
        values, depth_part = _fit_component(
            squared[rows, j], _hats(log_sigma[rows, j], knots), depth_basis[rows], settings.stiffness
        )
        sigma_knots.append(knots)
        sigma_values.append(values + np.log(margin[j]))
        depth_values.append(depth_part)
    fitted = Calibration(
        sigma_knots=tuple(map(tuple, sigma_knots)),
        sigma_values=tuple(map(tuple, sigma_values)),
        depth_knots=tuple(depth_knots),
        depth_values=tuple(map(tuple, depth_values)),
        floor=tuple(np.where(known.any(axis=0), floor, 0.0)),
        samples=len(labels),
    )
    return _completed(fitted, error, mean, sigma, settings)


def _completed(
    fitted: Calibration, error: Array, mean: Array, sigma: Array, settings: CalibrationSettings
) -> Calibration:
    """The standard error of the NEES, and the correlation where it is wanted."""
    z = error / (sigma * fitted.factors(mean, sigma))
    known = np.atleast_1d(np.isfinite(z).any(axis=0))
    deviation_of_nees = float(np.nanmean(z[:, known] ** 2, axis=1).std() / np.sqrt(len(z)))
    correlation: tuple[tuple[float, ...], ...] = ()
    if settings.correlation:
        whole = np.isfinite(z[:, known]).all(axis=1)
        second = np.eye(len(known))
        second[np.ix_(known, known)] = z[np.ix_(whole, known)].T @ z[np.ix_(whole, known)] / whole.sum()
        deviation = np.sqrt(np.diag(second))
        correlation = tuple(map(tuple, second / np.outer(deviation, deviation)))
    return dataclasses.replace(fitted, correlation=correlation, nees_error=deviation_of_nees)


def _fit_component(
    squared: Array, sigma_basis: Array, depth_basis: Array, stiffness: float
) -> tuple[Array, Array]:
    """Values at the knots that minimize sum(h + e^{-2h} z^2 / 2) + penalty, h = basis @ values; Newton.

    The sum over all knots' values is free, so that the mean of z^2 e^{-2h} comes out as 1.
    """
    count = sigma_basis.shape[1]
    basis = np.hstack([sigma_basis, depth_basis]) if depth_basis.shape[1] > 1 else sigma_basis
    penalty = np.zeros((basis.shape[1],) * 2)
    penalty[:count, :count] = _roughness(count)
    if depth_basis.shape[1] > 1:
        # Held near zero, too: a constant belongs to the other part.
        size = depth_basis.shape[1]
        penalty[count:, count:] = _roughness(size) + np.ones((size, size))
    penalty *= stiffness
    values = np.zeros(basis.shape[1])
    values[:count] = 0.5 * np.log(max(squared.mean(), 1e-12))
    for _ in range(_NEWTON_STEPS):
        weight = squared * np.exp(-2.0 * basis @ values)
        gradient = basis.T @ (1.0 - weight) + penalty @ values
        hessian = 2.0 * (basis * weight[:, None]).T @ basis + penalty
        step = np.linalg.solve(hessian + 1e-9 * np.eye(len(values)), gradient)
        largest = np.abs(step).max()
        values = values - step * min(1.0, 1.0 / max(largest, 1e-300))
        if largest < 1e-10:
            break
    depth_values = values[count:] if depth_basis.shape[1] > 1 else np.zeros(1)
    return values[:count], depth_values


def _roughness(count: int) -> Array:
    """Matrix P with v^T P v = sum of the squared differences of neighbors."""
    difference = np.diff(np.eye(count), axis=0)
    return difference.T @ difference


def _knots(values: Array, count: int) -> Array:
    """`count` knots with as many samples between each two; the ends lie inside the range, at 2 and 98 %."""
    quantiles = np.linspace(0.02, 0.98, count) if count > 1 else np.array([0.5])
    return np.unique(np.quantile(values, quantiles))


def _hats(values: Array, knots: Array) -> Array:
    """Basis (N, K) of the piecewise linear functions over the knots, constant beyond the ends."""
    return np.stack([np.interp(values, knots, unit) for unit in np.eye(len(knots))], axis=1)


def _check_data(labels: Array, mean: Array, sigma: Array, settings: CalibrationSettings) -> None:
    size = max(OUTPUTS, labels.shape[-1])
    for name, value in (("mean", mean), ("sigma", sigma), ("labels", labels)):
        if value.ndim != 2 or value.shape != (len(labels), size):
            raise CalibrationError(f"{name}: must have the shape ({len(labels)}, {size}), has {value.shape}")
        finite = np.isfinite(value)
        if value is labels:  # of the pose all rows are labelled or none; a row may lack a force
            finite = finite | (np.isnan(value) & (np.isnan(value).all(axis=0) | (np.arange(size) >= OUTPUTS)))
        if not finite.all():
            raise CalibrationError(f"{name}: {np.count_nonzero(~finite)} values are not finite")
    if not (sigma > 0.0).all():
        raise CalibrationError("sigma: must be positive")
    if len(labels) < settings.min_samples:
        raise CalibrationError(
            f"calibration needs at least {settings.min_samples} held-out samples, got {len(labels)}; "
            "the standard error of the joint NEES / 6 is about 0.7 / sqrt(N)"
        )


def _check_knots(where: str, knots: tuple[float, ...], values: tuple[float, ...]) -> None:
    if not knots or len(knots) != len(values) or np.any(np.diff(knots) <= 0.0):
        raise CalibrationError(f"{where}: must have one value for each of its increasing knots")


def _check_correlation(matrix: Array, size: int) -> None:
    if matrix.shape != (size, size) or not np.allclose(matrix, matrix.T):
        raise CalibrationError(f"correlation: must be a symmetric ({size}, {size}) matrix")
    if not np.allclose(np.diag(matrix), 1.0) or np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise CalibrationError("correlation: must have a unit diagonal and be positive definite")


def _finite_tuple(name: str, value: Any) -> Any:
    """Nested sequences as tuples of finite floats."""
    if isinstance(value, list | tuple):
        return tuple(_finite_tuple(name, element) for element in value)
    number = float(value)
    if not np.isfinite(number):
        raise CalibrationError(f"{name}: {number} is not finite")
    return number
