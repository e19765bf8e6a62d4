"""The paper's SE(3) discriminative Bayesian filter over the pose of the contact in the sensor.

Predict: the surface stands still in the base while the sensor moves, so the contact moves in the sensor by
T_k = (X_k^sens)^-1 X_{k-1}^sens, and process noise is added. Correct: the prediction is fused with the
estimate that was made from the image. What the paper's algorithm does not say is what happens when something
is wrong, and that is most of this file: estimates that are outliers, not finite, late or repeated, time that
jumps, gaps. Everything refused is counted by its reason.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaincinv

from tactile_filter import se3
from tactile_filter.fusion import FusionError, FusionStatus, check_gaussian, fuse
from tactile_filter.gaussian import PoseGaussian
from tactile_filter.settings import SettingError, Settings, setting

Array = NDArray[np.float64]

SECOND_NS = 1_000_000_000
DOF = 6


@dataclass(frozen=True)
class FilterSettings(Settings):
    """Everything about the filter that can be tuned; the defaults are the paper's except for the gate."""

    fusion_mode: str = setting(
        "paper",
        choices=("paper", "fast", "exact"),
        doc="paper: as published; fast: 3 iterations with the exact Jacobian; exact: to convergence",
    )
    iterations: int = setting(
        0, lower=0, upper=1000, doc="iterations of the fusion (mode exact: at most); 0 takes the mode's own"
    )
    jacobian_order: str = setting(
        "mode",
        choices=("mode", "2", "4", "exact"),
        doc="order of the inverse Jacobian; 'mode' takes the mode's",
    )
    process_noise_translation: float = setting(
        5e-4, lower=0.0, upper=1.0, unit="m", doc="standard deviation that a step adds to each translation"
    )
    process_noise_rotation: float = setting(
        math.radians(0.5), lower=0.0, upper=math.pi, unit="rad",
        doc="standard deviation that a step adds to each rotation",
    )  # fmt: skip
    process_noise_interval: float = setting(
        0.0, lower=0.0, upper=10.0, unit="s",
        doc="0: the noise is that of a step, however long (as in the paper); "
        "else: that of this much time, and its variance grows in proportion to the time elapsed",
    )  # fmt: skip
    gate_probability: float = setting(
        0.999999, lower=0.5, upper=1.0,
        doc="a measurement is refused if its NIS exceeds this quantile of chi-square with 6 degrees of "
        "freedom; 1 refuses none (as in the paper)",
    )  # fmt: skip
    reinitialize_after: int = setting(
        5,
        lower=1,
        upper=10000,
        doc="after this many measurements refused in a row the next starts a new belief",
    )
    max_prediction_age: float = setting(
        0.5, lower=0.001, upper=3600.0, unit="s",
        doc="a belief that was not corrected for longer is given up: nothing is predicted from it",
    )  # fmt: skip
    backward_jump: float = setting(
        1.0, lower=0.0, upper=3600.0, unit="s",
        doc="a measurement older than the last by more than this resets the filter; one older by "
        "less is refused",
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fusion_mode == "exact" and self.jacobian_order not in ("mode", "exact"):
            raise SettingError(
                f"jacobian_order = '{self.jacobian_order}': fusion_mode 'exact' needs 'exact' or 'mode'"
            )


class BeliefFlag(IntFlag):
    """What a belief rests on; the values are those of tactile_msgs/ContactState."""

    MEASUREMENT_FUSED = 1
    PREDICTED_ONLY = 2
    GATED = 4
    REINITIALIZED = 8
    NO_CONTACT = 16
    INVALID = 32
    NOT_CONVERGED = 64


@dataclass(frozen=True)
class Belief:
    """The contact's pose in the sensor, X_sf = exp(eps^) mean with eps ~ N(0, cov).

    Attributes
    ----------
    stamp_ns : int
        When it holds.
    mean, cov : (4, 4) pose and (6, 6) left covariance in m and rad; NaN where flags has INVALID
    nis : float
        Normalized innovation squared of the measurement against the prediction; NaN without both.
    nis_dof : int
        Its degrees of freedom: 6, or 0 where nis is NaN.
    flags : BeliefFlag
    reason : str
        Why a measurement was not fused or the belief was restarted; empty in the regular case.
    rejected : int
        Measurements refused since the last reset.
    """

    stamp_ns: int
    mean: Array
    cov: Array
    nis: float = math.nan
    nis_dof: int = 0
    flags: BeliefFlag = BeliefFlag.MEASUREMENT_FUSED
    reason: str = ""
    rejected: int = 0

    @property
    def valid(self) -> bool:
        """Whether mean and cov may be used."""
        return not self.flags & BeliefFlag.INVALID


@dataclass(frozen=True)
class _State:
    """What the filter knows between two steps; `corrected_ns` is the stamp of the last measurement fused."""

    stamp_ns: int
    mean: Array
    cov: Array
    T_base_sensor: Array
    corrected_ns: int


class ContactFilter:
    """Bayesian filter over the contact's pose in the sensor; see the module's text.

    Attributes
    ----------
    rejections : Counter
        Measurements refused since the last reset by reason: "outlier", "not usable", "out of order",
        "same stamp", "sensor pose", "not fusable".
    resets : Counter
        Restarts since construction, by reason.
    """

    def __init__(self, settings: FilterSettings | None = None) -> None:
        self.rejections: Counter[str] = Counter()
        self.resets: Counter[str] = Counter()
        self._state: _State | None = None
        self._refused_in_a_row = 0
        self.configure(FilterSettings() if settings is None else settings)

    @property
    def has_belief(self) -> bool:
        """Whether anything is believed now."""
        return self._state is not None

    @property
    def rejected(self) -> int:
        """Measurements refused since the last reset."""
        return sum(self.rejections.values())

    def configure(self, settings: FilterSettings) -> None:
        """Take other settings from the next step on; the belief stays."""
        self.settings = settings
        self.gate = gate_threshold(settings.gate_probability)
        variances = (settings.process_noise_translation**2, settings.process_noise_rotation**2)
        self._noise = np.diag(np.repeat(variances, 3))
        order: str | int | None = settings.jacobian_order
        self._order = {"mode": None, "2": 2, "4": 4, "exact": "exact"}[str(order)]

    def reset(self, reason: str) -> None:
        """Forget the belief and the counts of refused measurements."""
        self._state = None
        self._refused_in_a_row = 0
        self.rejections.clear()
        self.resets[reason] += 1

    def step(self, stamp_ns: int, measurement: PoseGaussian, T_base_sensor: ArrayLike) -> Belief:
        """Predict to the measurement's stamp and fuse it.

        Parameters
        ----------
        stamp_ns : int
            Exposure of the image that the measurement was made from.
        measurement : PoseGaussian
            Estimate of X_sf. One that is not finite or has no positive definite covariance is refused; the
            step then only predicts.
        T_base_sensor : (4, 4)
            The sensor's pose in a frame in which the surface stands still, at that stamp.

        Returns
        -------
        Belief
            At `stamp_ns`; at the stamp of the last step if this one is not later.
        """
        stamp_ns = int(stamp_ns)
        sensor = _pose_or_none(T_base_sensor)
        if sensor is None:
            return self._refuse_unmoved("sensor pose", "the sensor's pose is not usable", stamp_ns)
        restarted = ""
        if self._state is not None:
            behind = self._state.stamp_ns - stamp_ns
            if behind > self.settings.backward_jump * SECOND_NS:
                restarted = "time jumped back"
                self.reset(restarted)
            elif behind >= 0:
                which = "same stamp" if behind == 0 else "out of order"
                text = f"measurement of {stamp_ns} ns comes after that of {self._state.stamp_ns} ns: {which}"
                return self._refuse_unmoved(which, text, stamp_ns)
        return self._step_forward(stamp_ns, measurement, sensor, restarted)

    def predict_to(self, stamp_ns: int, T_base_sensor: ArrayLike) -> Belief:
        """The belief moved on to a stamp without a measurement, to make up for latency; changes nothing."""
        stamp_ns = int(stamp_ns)
        sensor = _pose_or_none(T_base_sensor)
        if sensor is None:
            return self._invalid(stamp_ns, "the sensor's pose is not usable")
        if self._state is None:
            return self._invalid(stamp_ns, "nothing has been measured yet")
        if stamp_ns < self._state.stamp_ns:
            return self._invalid(stamp_ns, f"the belief is of {self._state.stamp_ns} ns, which is later")
        if self._is_stale(stamp_ns):
            return self._invalid(stamp_ns, self._stale_text(stamp_ns))
        predicted = self._predicted(self._state, stamp_ns, sensor)
        return self._belief(predicted, BeliefFlag.PREDICTED_ONLY)

    def _step_forward(
        self, stamp_ns: int, measurement: PoseGaussian, sensor: Array, restarted: str
    ) -> Belief:
        """The regular step: the stamp is later than the last one, the sensor's pose is sound."""
        try:
            check_gaussian(measurement.mean, measurement.cov, "measurement")
        except FusionError as error:
            return self._refuse_moved("not usable", str(error), stamp_ns, sensor)
        if self._state is None:
            return self._initialize(stamp_ns, measurement, sensor, restarted)
        if self._is_stale(stamp_ns):
            return self._initialize(stamp_ns, measurement, sensor, self._stale_text(stamp_ns))
        predicted = self._predicted(self._state, stamp_ns, sensor)
        nis = normalized_innovation_squared(measurement, predicted.mean, predicted.cov)
        if not nis <= self.gate:
            return self._refuse_outlier(stamp_ns, measurement, sensor, nis)
        return self._correct(measurement, predicted, nis)

    def _correct(self, measurement: PoseGaussian, predicted: _State, nis: float) -> Belief:
        s = self.settings
        try:
            result = fuse(
                measurement.mean, measurement.cov, predicted.mean, predicted.cov, s.fusion_mode,
                iterations=s.iterations or None, jacobian_order=self._order,
            )  # fmt: skip
        except FusionError as error:
            stamp_ns, sensor = predicted.stamp_ns, predicted.T_base_sensor
            return self._refuse_moved("not fusable", str(error), stamp_ns, sensor, nis)
        self._refused_in_a_row = 0
        stamp_ns = predicted.stamp_ns
        self._state = _State(stamp_ns, result.mean, result.cov, predicted.T_base_sensor, stamp_ns)
        flags = BeliefFlag.MEASUREMENT_FUSED
        if result.status != FusionStatus.CONVERGED:
            flags |= BeliefFlag.NOT_CONVERGED
        return self._belief(self._state, flags, nis=nis)

    def _initialize(
        self, stamp_ns: int, measurement: PoseGaussian, sensor: Array, reason: str, nis: float = math.nan
    ) -> Belief:
        """Start from the measurement alone (the algorithm's initialization)."""
        self._refused_in_a_row = 0
        mean = se3.orthonormalized(measurement.mean)
        cov = 0.5 * (measurement.cov + measurement.cov.T)
        self._state = _State(stamp_ns, mean, cov, sensor, stamp_ns)
        flags = BeliefFlag.MEASUREMENT_FUSED | BeliefFlag.REINITIALIZED
        return self._belief(self._state, flags, reason, nis)

    def _refuse_outlier(self, stamp_ns: int, measurement: PoseGaussian, sensor: Array, nis: float) -> Belief:
        refused = self._refused_in_a_row
        text = f"NIS {nis:.4g} is above the gate {self.gate:.4g}"
        if refused >= self.settings.reinitialize_after:
            self.resets["outliers in a row"] += 1
            return self._initialize(
                stamp_ns, measurement, sensor, f"{text} after {refused} refused in a row", nis
            )
        return self._refuse_moved("outlier", text, stamp_ns, sensor, nis, BeliefFlag.GATED)

    def _refuse_moved(
        self, reason: str, text: str, stamp_ns: int, sensor: Array, nis: float = math.nan, flag: int = 0
    ) -> Belief:
        """Count the measurement as refused and let the step be a prediction: time has passed all the same."""
        self.rejections[reason] += 1
        self._refused_in_a_row += 1
        if self._state is None:
            return self._invalid(stamp_ns, text)
        if self._is_stale(stamp_ns):
            return self._invalid(stamp_ns, f"{text}; {self._stale_text(stamp_ns)}")
        self._state = self._predicted(self._state, stamp_ns, sensor)
        return self._belief(self._state, BeliefFlag.PREDICTED_ONLY | flag, text, nis)

    def _refuse_unmoved(self, reason: str, text: str, stamp_ns: int) -> Belief:
        """Count the measurement as refused where nothing can be predicted; the belief stays what it is."""
        self.rejections[reason] += 1
        if self._state is None:
            return self._invalid(stamp_ns, text)
        return self._belief(self._state, BeliefFlag.PREDICTED_ONLY, text)

    def _predicted(self, state: _State, stamp_ns: int, sensor: Array) -> _State:
        """The algorithm's prediction step, with the adjoint of T_k."""
        T_k = se3.inverse(sensor) @ state.T_base_sensor
        adjoint = se3.adjoint(T_k)
        cov = adjoint @ state.cov @ adjoint.T
        cov = 0.5 * (cov + cov.T) + self._noise_since(stamp_ns - state.stamp_ns)
        return _State(stamp_ns, se3.orthonormalized(T_k @ state.mean), cov, sensor, state.corrected_ns)

    def _noise_since(self, elapsed_ns: int) -> Array:
        interval = self.settings.process_noise_interval
        if interval == 0.0:
            return self._noise if elapsed_ns > 0 else np.zeros((DOF, DOF))
        return self._noise * (elapsed_ns / SECOND_NS / interval)

    def _is_stale(self, stamp_ns: int) -> bool:
        assert self._state is not None
        return stamp_ns - self._state.corrected_ns > self.settings.max_prediction_age * SECOND_NS

    def _stale_text(self, stamp_ns: int) -> str:
        assert self._state is not None
        age = (stamp_ns - self._state.corrected_ns) / SECOND_NS
        return f"no measurement fused for {age:.3f} s, more than {self.settings.max_prediction_age:g} s"

    def _belief(self, state: _State, flags: int, reason: str = "", nis: float = math.nan) -> Belief:
        dof = 0 if math.isnan(nis) else DOF
        return Belief(
            state.stamp_ns, state.mean, state.cov, nis, dof, BeliefFlag(flags), reason, self.rejected
        )

    def _invalid(self, stamp_ns: int, reason: str) -> Belief:
        mean, cov = np.full((4, 4), math.nan), np.full((DOF, DOF), math.nan)
        flags = BeliefFlag.INVALID | BeliefFlag.PREDICTED_ONLY
        return Belief(stamp_ns, mean, cov, flags=flags, reason=reason, rejected=self.rejected)


def gate_threshold(probability: float, dof: int = DOF) -> float:
    """Quantile of chi-square; infinite at probability 1."""
    return math.inf if probability >= 1.0 else 2.0 * float(gammaincinv(0.5 * dof, probability))


def normalized_innovation_squared(measurement: PoseGaussian, mean: Array, cov: Array) -> float:
    """NIS of a measurement against a predicted Gaussian.

    With X = exp(a^) X_obs = exp(b^) X_bel the innovation nu = log(X_obs X_bel^-1) obeys
    exp(nu^) = exp(-a^) exp(b^), so to first order in a and b about nu its covariance is
    S = J(nu)^-1 Sigma_obs J(nu)^-T + J(-nu)^-1 Sigma_bel J(-nu)^-T.
    """
    nu = se3.log(measurement.mean @ se3.inverse(mean))
    left, right = se3.inverse_left_jacobian(nu), se3.inverse_left_jacobian(-nu)
    S = left @ measurement.cov @ left.T + right @ cov @ right.T
    try:
        whitened = np.linalg.solve(np.linalg.cholesky(0.5 * (S + S.T)), nu)
    except np.linalg.LinAlgError:
        return math.inf
    return float(whitened @ whitened)


def _pose_or_none(T: ArrayLike) -> Array | None:
    try:
        return se3.orthonormalized(T)
    except ValueError:
        return None
