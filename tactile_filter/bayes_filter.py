"""The paper's SE(3) discriminative Bayesian filter over the pose of the contact in the sensor.

Predict: the surface stands still in the base while the sensor moves, so the contact moves in the sensor by
T_k = (X_k^sens)^-1 X_{k-1}^sens, and process noise is added. Correct: the prediction is fused with the
estimate that was made from the image. What the paper's algorithm does not say is what happens when something
is wrong, and that is most of this file: lost contact, estimates that are outliers, not finite, late or
repeated, time that jumps, gaps. Everything refused is counted by its reason.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.stamps import SECOND_NS
from tactile_filter.belief import Belief, BeliefFlag, invalid_belief
from tactile_filter.contact_bounds import ContactBounds
from tactile_filter.filter_settings import FilterSettings, Tuning, gate_threshold
from tactile_filter.fusion import FusionError, FusionStatus, check_gaussian, fuse
from tactile_filter.history import Entry, History, Key
from tactile_filter.propagation import Innovation, innovation, predict
from tactile_filter.robust import Spectrum, huber_inflation, student_t_inflation
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian
from tactile_geometry.se3 import usable_pose

__all__ = ["Belief", "BeliefFlag", "ContactFilter", "FilterSettings", "gate_threshold"]

Array = NDArray[np.float64]

DOF = 6

_FUSED = BeliefFlag.MEASUREMENT_FUSED
_STARTED = BeliefFlag.MEASUREMENT_FUSED | BeliefFlag.REINITIALIZED
_NOT_CONVERGED = BeliefFlag.MEASUREMENT_FUSED | BeliefFlag.NOT_CONVERGED
_PREDICTED = BeliefFlag.PREDICTED_ONLY
_GATED = BeliefFlag.PREDICTED_ONLY | BeliefFlag.GATED
_REPEATED = 5e-4  # m; an arm that has moved by more than this sees no estimate that equals another to the bit
_OVERFLOW = "the prediction is beyond double precision"


class _State(NamedTuple):
    """What the filter knows between two steps; `corrected_ns` is the stamp of the last measurement fused."""

    stamp_ns: int
    mean: Array
    cov: Array
    T_base_sensor: Array
    corrected_ns: int


class _Told(NamedTuple):
    """The mean of the last measurement as bytes, and where the sensor was when it was first told."""

    mean: bytes
    T_base_sensor: Array


class _Memory(NamedTuple):
    """Everything that a step changes."""

    state: _State | None
    told: _Told | None
    refused_in_a_row: int
    rejections: Counter[str]
    rejections_before_reset: Counter[str]
    resets: Counter[str]


class ContactFilter:
    """Bayesian filter over the contact's pose in the sensor; see the module's text.

    Parameters
    ----------
    bounds : ContactBounds, optional
        What the sensor can feel; measurements outside of that are refused.

    Attributes
    ----------
    late : with a `history`: measurements that came late since the last reset, by what became of them: "put in
        place" or "too late"
    """

    def __init__(self, settings: FilterSettings | None = None, bounds: ContactBounds | None = None) -> None:
        self.bounds = bounds
        self.late: Counter[str] = Counter()
        self._state: _State | None = None
        self._told: _Told | None = None
        self._refused_in_a_row = 0
        self._rejections: Counter[str] = Counter()  # counters are replaced, never changed: see _memory
        self._rejections_before_reset: Counter[str] = Counter()
        self._resets: Counter[str] = Counter()
        self._history = History(0)
        self.configure(FilterSettings() if settings is None else settings)

    @property
    def settings(self) -> FilterSettings:
        """The settings in force."""
        return self._tuning.settings

    @property
    def gate(self) -> float:
        """The NIS above which a measurement is refused."""
        return self._tuning.gate

    @property
    def has_belief(self) -> bool:
        """Whether anything is believed now."""
        return self._state is not None

    @property
    def rejections(self) -> Counter[str]:
        """Measurements refused since the last reset by reason: "outlier", "not usable",
        "not plausible", "out of order", "same stamp", "too late", "sensor pose", "not fusable".
        """
        late = self.late["too late"]
        return self._rejections + Counter({"too late": late}) if late else self._rejections

    @property
    def rejected(self) -> int:
        """Measurements refused since the last reset."""
        refused = sum(self._rejections.values()) if self._rejections else 0
        return refused + self.late["too late"] if self.late else refused

    @property
    def all_rejections(self) -> Counter[str]:
        """Refused measurements by reason, since construction."""
        return self._rejections_before_reset + self.rejections

    @property
    def resets(self) -> Counter[str]:
        """Restarts since construction, by reason."""
        return self._resets

    def configure(self, settings: FilterSettings) -> None:
        """Take other settings from the next step on; the belief stays."""
        self._tuning = Tuning.of(settings)
        self._history.span_ns = round(settings.history * SECOND_NS)
        if self._history.span_ns == 0:
            self._history.clear()

    def reset(self, reason: str, stamp_ns: int | None = None) -> None:
        """Forget the belief and the counts of refused measurements.

        With a `history`, measurements of `stamp_ns` and earlier ones that are still to come are too late.
        """
        self._forget(reason)
        self._history.clear(stamp_ns)

    def observe(
        self, stamp_ns: int, estimate: PoseGaussian | None, T_base_sensor: ArrayLike | None
    ) -> Belief:
        """Take the result of one exposure: `step` with its estimate; without contact, forget the belief.

        The belief that is returned without contact has the flags NO_CONTACT and INVALID.

        Parameters
        ----------
        stamp_ns : of the exposure
        estimate : estimate of X_sf; None: there is no contact
        T_base_sensor : (4, 4) or None, as for `step`; not needed without contact
        """
        if estimate is not None:
            return self.step(stamp_ns, estimate, T_base_sensor)
        if self.has_belief:
            self.reset("no contact", stamp_ns)
        return invalid_belief(int(stamp_ns), BeliefFlag.NO_CONTACT, rejected=self.rejected)

    def step(
        self,
        stamp_ns: int,
        measurement: PoseGaussian,
        T_base_sensor: ArrayLike | None,
        *,
        source: str = "",
        sequence: int = 0,
    ) -> Belief:
        """Predict to the measurement's stamp and fuse it; put it in its place if it comes late.

        The belief is of `stamp_ns`, or of the stamp of the last step if this one is not later.

        Parameters
        ----------
        stamp_ns : exposure of the image that the measurement was made from
        measurement : estimate of X_sf. One that is not finite or has no positive definite covariance is
            refused; the step then only predicts.
        T_base_sensor : (4, 4) the sensor's pose in a frame in which the surface stands still, at that stamp.
            A measurement whose pose is none is refused, and the belief stays what it is.
        source, sequence : order of measurements of the same stamp (of which the first is fused)
        """
        stamp_ns = int(stamp_ns)
        sensor = usable_pose(T_base_sensor)
        if self._history.span_ns == 0:
            return self._step_in_order(stamp_ns, measurement, sensor)
        entry = Entry(Key(stamp_ns, source, sequence), measurement, sensor, self._tuning, self._memory())
        return self._step_in_place(entry)

    def _step_in_place(self, entry: Entry) -> Belief:
        """Step from where the entry belongs, through all that came before it but belongs after it."""
        history, stamp_ns = self._history, entry.key.stamp_ns
        newest_ns = history.newest_ns
        if newest_ns is not None and newest_ns - stamp_ns > self._tuning.backward_jump_ns:
            history.clear()
        elif not history.takes(stamp_ns):
            self.late["too late"] += 1
            text = (
                f"measurement of {stamp_ns} ns is too late: the last is of {newest_ns} ns, and the history "
            )
            return self._unmoved(f"{text}is {self.settings.history:g} s", stamp_ns)
        following = history.insert(entry)
        if len(following) == 1:
            return self._step_in_order(stamp_ns, entry.measurement, entry.T_base_sensor)
        self.late["put in place"] += 1
        self._recall(entry.before)
        newest_tuning = self._tuning
        for each in following:
            each.before, self._tuning = self._memory(), each.tuning
            belief = self._step_in_order(each.key.stamp_ns, each.measurement, each.T_base_sensor)
        self._tuning = newest_tuning
        return belief

    def _memory(self) -> _Memory:
        counts = self._rejections, self._rejections_before_reset, self._resets
        return _Memory(self._state, self._told, self._refused_in_a_row, *counts)

    def _recall(self, memory: _Memory) -> None:
        self._state, self._told, self._refused_in_a_row = memory.state, memory.told, memory.refused_in_a_row
        self._rejections, self._rejections_before_reset = memory.rejections, memory.rejections_before_reset
        self._resets = memory.resets

    def _step_in_order(self, stamp_ns: int, measurement: PoseGaussian, sensor: Array | None) -> Belief:
        if sensor is None:
            return self._refuse_unmoved("sensor pose", "the sensor's pose is not usable", stamp_ns)
        restarted = ""
        if self._state is not None:
            behind = self._state.stamp_ns - stamp_ns
            if behind > self._tuning.backward_jump_ns:
                restarted = "time jumped back"
                self._forget(restarted)
            elif behind >= 0:
                which = "same stamp" if behind == 0 else "out of order"
                text = f"measurement of {stamp_ns} ns comes after that of {self._state.stamp_ns} ns: {which}"
                return self._refuse_unmoved(which, text, stamp_ns)
        return self._step_forward(stamp_ns, measurement, sensor, restarted)

    def predict_to(self, stamp_ns: int, T_base_sensor: ArrayLike) -> Belief:
        """The belief moved on to a stamp without a measurement, to make up for latency; changes nothing."""
        stamp_ns = int(stamp_ns)
        sensor = usable_pose(T_base_sensor)
        if sensor is None:
            return self._invalid(stamp_ns, "the sensor's pose is not usable")
        if self._state is None:
            return self._invalid(stamp_ns, "nothing has been measured yet")
        if stamp_ns < self._state.stamp_ns:
            return self._invalid(stamp_ns, f"the belief is of {self._state.stamp_ns} ns, which is later")
        if self._is_stale(self._state, stamp_ns):
            return self._invalid(stamp_ns, self._stale_text(self._state, stamp_ns))
        predicted = self._predicted(self._state, stamp_ns, sensor)
        if not _is_finite(predicted):
            return self._invalid(stamp_ns, _OVERFLOW)
        return self._belief(predicted, _PREDICTED)

    def _step_forward(
        self, stamp_ns: int, measurement: PoseGaussian, sensor: Array, restarted: str
    ) -> Belief:
        """The regular step: the stamp is later than the last one, the sensor's pose is sound."""
        try:
            check_gaussian(measurement.mean, measurement.cov, "measurement")
        except FusionError as error:
            return self._refuse_moved("not usable", str(error), stamp_ns, sensor)
        implausible = self._implausible(measurement, sensor)
        if implausible:
            refused = self._refused_in_a_row  # what cannot be refutes no belief
            belief = self._refuse_moved("not plausible", implausible, stamp_ns, sensor)
            self._refused_in_a_row = refused
            return belief
        if self._state is None:
            return self._initialize(stamp_ns, measurement, sensor, restarted)
        if self._is_stale(self._state, stamp_ns):
            return self._initialize(stamp_ns, measurement, sensor, self._stale_text(self._state, stamp_ns))
        try:
            predicted = self._predicted(self._state, stamp_ns, sensor)
            surprise = innovation(measurement.mean, measurement.cov, predicted.mean, predicted.cov)
        except ValueError:
            return self._initialize(stamp_ns, measurement, sensor, _OVERFLOW)
        if not surprise.nis <= self._tuning.gate:
            return self._refuse_outlier(measurement, predicted, surprise)
        return self._correct(measurement, predicted, surprise)

    def _implausible(self, measurement: PoseGaussian, sensor: Array) -> str:
        """Why this sensor cannot have felt what was measured; empty if it can."""
        if self.bounds is None:
            return ""
        objection = self.bounds.objection(measurement.mean) or self.bounds.sigma_objection(measurement.cov)
        return objection or self._repeated(measurement, sensor)

    def _repeated(self, measurement: PoseGaussian, sensor: Array) -> str:
        """Why this is the last measurement once more; empty where it is a new one, or may be the same."""
        told = measurement.mean.tobytes()
        if self._told is None or told != self._told.mean:
            self._told = _Told(told, sensor)
            return ""
        way = se3.norm(sensor[:3, 3] - self._told.T_base_sensor[:3, 3])
        if way <= _REPEATED:
            return ""
        return f"the same contact to the bit although the sensor has moved by {way * 1e3:.1f} mm"

    def _correct(self, measurement: PoseGaussian, predicted: _State, surprise: Innovation) -> Belief:
        tuning = self._tuning
        cov, inflation = measurement.cov, 1.0
        try:
            if tuning.settings.robust != "none":
                inflation = self._inflation(measurement, predicted)
                cov = inflation * cov
            result = fuse(
                measurement.mean, cov, predicted.mean, predicted.cov, tuning.settings.fusion_mode,
                iterations=tuning.iterations, jacobian_order=tuning.jacobian_order,
            )  # fmt: skip
        except FusionError as error:
            return self._refuse_predicted("not fusable", str(error), predicted, _PREDICTED, surprise)
        self._refused_in_a_row = 0
        stamp_ns = predicted.stamp_ns
        state = _State(stamp_ns, result.mean, result.cov, predicted.T_base_sensor, stamp_ns)
        self._state = state
        flags = _FUSED if result.status == FusionStatus.CONVERGED else _NOT_CONVERGED
        return self._belief(state, flags, "", surprise, inflation)

    def _inflation(self, measurement: PoseGaussian, predicted: _State) -> float:
        settings = self._tuning.settings
        spectrum = Spectrum(measurement, predicted.mean, predicted.cov)
        if settings.robust == "student_t":
            return student_t_inflation(spectrum, settings.student_t_dof)
        return huber_inflation(spectrum, settings.huber_threshold)

    def _initialize(
        self,
        stamp_ns: int,
        measurement: PoseGaussian,
        sensor: Array,
        reason: str,
        surprise: Innovation | None = None,
    ) -> Belief:
        """Start from the measurement alone (the algorithm's initialization)."""
        self._refused_in_a_row = 0
        mean = se3.orthonormalized(measurement.mean)
        cov = 0.5 * (measurement.cov + measurement.cov.T)
        self._state = _State(stamp_ns, mean, cov, sensor, stamp_ns)
        return self._belief(self._state, _STARTED, reason, surprise)

    def _refuse_outlier(self, measurement: PoseGaussian, predicted: _State, surprise: Innovation) -> Belief:
        refused = self._refused_in_a_row
        text = f"NIS {surprise.nis:.4g} is above the gate {self.gate:.4g}"
        if refused < self.settings.reinitialize_after:
            return self._refuse_predicted("outlier", text, predicted, _GATED, surprise)
        if self.bounds is not None:
            believed, found = (predicted.corrected_ns, predicted.mean), (predicted.stamp_ns, measurement.mean)
            beyond = self.bounds.unreachable(believed, found)
            if beyond:
                text = f"{text}, and the contact would have {beyond}"
                return self._refuse_predicted("outlier", text, predicted, _GATED, surprise)
        self._count_reset("outliers in a row")
        text = f"{text} after {refused} refused in a row"
        return self._initialize(predicted.stamp_ns, measurement, predicted.T_base_sensor, text, surprise)

    def _refuse_moved(self, reason: str, text: str, stamp_ns: int, sensor: Array) -> Belief:
        """Count the measurement as refused and let the step be a prediction: time has passed all the same."""
        if self._state is not None and not self._is_stale(self._state, stamp_ns):
            predicted = self._predicted(self._state, stamp_ns, sensor)
            return self._refuse_predicted(reason, text, predicted, _PREDICTED)
        self._count_refused(reason)
        self._refused_in_a_row += 1
        if self._state is not None:
            text = f"{text}; {self._stale_text(self._state, stamp_ns)}"
        return self._invalid(stamp_ns, text)

    def _refuse_predicted(
        self, reason: str, text: str, predicted: _State, flags: BeliefFlag, surprise: Innovation | None = None
    ) -> Belief:
        """Count the measurement as refused and believe what was predicted."""
        self._count_refused(reason)
        self._refused_in_a_row += 1
        if not _is_finite(predicted):
            self._state = None
            return self._invalid(predicted.stamp_ns, f"{text}; {_OVERFLOW}")
        self._state = predicted
        return self._belief(predicted, flags, text, surprise)

    def _refuse_unmoved(self, reason: str, text: str, stamp_ns: int) -> Belief:
        """Count the measurement as refused where nothing can be predicted; the belief stays what it is."""
        self._count_refused(reason)
        return self._unmoved(text, stamp_ns)

    def _unmoved(self, text: str, stamp_ns: int) -> Belief:
        if self._state is None:
            return self._invalid(stamp_ns, text)
        return self._belief(self._state, _PREDICTED, text)

    def _count_refused(self, reason: str) -> None:
        self._rejections = self._rejections + Counter((reason,))

    def _count_reset(self, reason: str) -> None:
        self._resets = self._resets + Counter((reason,))

    def _forget(self, reason: str) -> None:
        self._state = self._told = None
        self._refused_in_a_row = 0
        self._rejections_before_reset = self.all_rejections
        self._rejections = Counter()
        self.late = Counter()
        self._count_reset(reason)

    def _predicted(self, state: _State, stamp_ns: int, sensor: Array) -> _State:
        """The algorithm's prediction step."""
        variances = self._tuning.noise_since(stamp_ns - state.stamp_ns)
        mean, cov = predict(state.mean, state.cov, state.T_base_sensor, sensor, variances)
        return _State(stamp_ns, mean, cov, sensor, state.corrected_ns)

    def _is_stale(self, state: _State, stamp_ns: int) -> bool:
        return stamp_ns - state.corrected_ns > self._tuning.max_age_ns

    def _stale_text(self, state: _State, stamp_ns: int) -> str:
        age = (stamp_ns - state.corrected_ns) / SECOND_NS
        return f"no measurement fused for {age:.3f} s, more than {self.settings.max_prediction_age:g} s"

    def _belief(
        self,
        state: _State,
        flags: BeliefFlag,
        reason: str = "",
        surprise: Innovation | None = None,
        inflation: float = 1.0,
    ) -> Belief:
        nis, whitened, dof = surprise or (math.nan, None, 0)
        mean, cov = state.mean, state.cov
        return Belief(state.stamp_ns, mean, cov, nis, dof, flags, reason, self.rejected, whitened, inflation)

    def _invalid(self, stamp_ns: int, reason: str) -> Belief:
        return invalid_belief(stamp_ns, _PREDICTED, reason, self.rejected)


def _is_finite(state: _State) -> bool:
    return bool(np.isfinite(state.mean).all() and np.isfinite(state.cov).all())
