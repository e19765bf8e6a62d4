"""Time offset between camera and arm, from an arm that moves back and forth in contact.

What the images say of the depth, y_i at the stamps t_i of the exposures, follows where the arm is along the
sensor's axis, s(t): through skin and network, which may bend it but are taken to have no memory:

    y_i = a + b s(t_i + tau) + c s(t_i + tau)^2 + e_i

tau is what has to be added to the stamps of the exposures. It is sought where both sides, depth growing along
the axis, correlate most, within `LARGEST` on both sides. In stretches of one length it is found again, by the
linear part of the same equation: how these offsets stray, weighted by the motion in each stretch, is its
uncertainty, and no less than what the residuals e_i would make if they knew nothing of each other. How the
offsets go on in time is the drift of the two clocks. A skin that lags behind adds to tau.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from tactile_base.stamps import NANOSECOND
from tactile_records.calibrating.result import CalibrationError
from tactile_records.runs.euler_poses import inverses
from tactile_records.runs.record import RunRecord

Array = NDArray[np.float64]

LARGEST = 0.3  # s, that is looked for on both sides
_STEP = 0.004  # s, between the offsets that are tried first
_LEAST_MOTION = 3e-4  # m, standard deviation of the arm's way back and forth
_LEAST_CORRELATION = 0.9
_LEAST_SAMPLES = 100
_STRETCHES = 10
_TURNS = 4  # of the arm, back or forth


@dataclass(frozen=True)
class TimeOffset:
    """What was found; all times in s.

    Attributes
    ----------
    seconds, sigma : float
        To be added to the stamps of the exposures, and its standard deviation.
    drift, drift_sigma : float
        Change of the offset in a second (1e-6 is one part in a million), and its standard deviation.
    correlation : float
        Of the depth with what the arm's motion explains of it, at that offset.
    residual : float
        Root mean square of what it does not explain, m.
    tried, correlations : ndarray (N,)
        Offsets that were tried, and the correlation at each.
    stretch_times, stretch_offsets : ndarray (K,)
        Middle of each stretch since the first exposure, and the offset found in it.
    stretch_weights : ndarray (K,)
        How much of the motion was in it; their sum is 1.
    times, depth, explained, unshifted : ndarray (M,)
        Of each exposure: seconds since the first, depth (m), and what the motion says with the offset and
        without.
    """

    seconds: float
    sigma: float
    drift: float
    drift_sigma: float
    correlation: float
    residual: float
    tried: Array
    correlations: Array
    stretch_times: Array
    stretch_offsets: Array
    stretch_weights: Array
    times: Array
    depth: Array
    explained: Array
    unshifted: Array


def of_record(record: RunRecord) -> TimeOffset:
    """The offset in a run, from all of its estimates; raises `CalibrationError` where it does not show."""
    estimate, pose = record.estimate, record.pose
    if record.command.stamp_ns.size:  # ours: what was done before and after the oscillations says nothing
        estimate = estimate.rows(record.working(estimate.stamp_ns))
    if len(estimate) < _LEAST_SAMPLES or len(pose) < 10:
        raise CalibrationError(
            f"{len(estimate)} estimates in contact and {len(pose)} poses of the arm: must be at least "
            f"{_LEAST_SAMPLES} and 10; move the arm back and forth in contact for ten seconds"
        )
    start_ns = int(estimate.stamp_ns[0])
    during = (pose.stamp_ns >= start_ns) & (pose.stamp_ns <= estimate.stamp_ns[-1])
    axis = pose.T_base_sensor[during, :3, 2].mean(axis=0)
    return estimated(
        (estimate.stamp_ns - start_ns) * NANOSECOND,
        inverses(estimate.mean)[:, 2, 3],
        (pose.stamp_ns - start_ns) * NANOSECOND,
        pose.T_base_sensor[:, :3, 3] @ axis,
    )


def estimated(times: Array, depth: Array, arm_times: Array, position: Array) -> TimeOffset:
    """The offset of `depth` (M,) m at `times` (M,) s against where the arm is.

    Parameters
    ----------
    arm_times, position : ndarray (N,)
        When the arm was where along the sensor's axis, s and m.

    Raises
    ------
    CalibrationError
        Where it cannot be told, with what would be right.
    """
    arm_times, first = np.unique(arm_times, return_index=True)
    position = position[first]
    covered = (times >= arm_times[0] + LARGEST) & (times <= arm_times[-1] - LARGEST)
    times, depth = times[covered], depth[covered]
    if len(times) < _LEAST_SAMPLES:
        raise CalibrationError(
            f"the arm's poses cover {len(times)} estimates with {LARGEST:g} s on both sides, must be at "
            f"least {_LEAST_SAMPLES}: record on for a second after the last touch"
        )
    way = _way(times, arm_times, position)

    tried = np.arange(-LARGEST, LARGEST + _STEP / 2, _STEP)
    correlations = np.array([_Fit(way, times + tau, depth, 1).correlation for tau in tried])
    best = int(correlations.argmax())
    if correlations[best] < _LEAST_CORRELATION:
        raise CalibrationError(
            f"the arm's motion explains the depths in the images with a correlation of no more than "
            f"{correlations[best]:.2f}, must be {_LEAST_CORRELATION:g}: was the sensor in contact all the "
            f"time, and do its network's depths follow the surface?"
        )
    if best in (0, len(tried) - 1):
        raise CalibrationError(
            f"the offset is not within {LARGEST:g} s: are both on the same clock (`tactile doctor`)?"
        )
    around = tried[best - 1], tried[best + 1]
    found = minimize_scalar(
        lambda t: float(_Fit(way, times + t, depth).rest.std()),
        bounds=around,
        method="bounded",
        options={"xatol": 1e-6},
    )
    tau = float(found.x)
    fit = _Fit(way, times + tau, depth)
    middles, offsets, weights = _stretches(fit, times, tau)
    spread, drift, drift_sigma = _line(middles, offsets, weights)
    # a few stretches may agree by chance: no less than what residuals that know nothing of each other make
    sigma = max(spread, float(np.linalg.norm(fit.rest) / np.linalg.norm(fit.speed) / np.sqrt(len(times))))
    return TimeOffset(
        seconds=tau,
        sigma=sigma,
        drift=drift,
        drift_sigma=drift_sigma,
        correlation=fit.correlation,
        residual=float(np.sqrt(np.mean(fit.rest**2))),
        tried=tried,
        correlations=correlations,
        stretch_times=middles,
        stretch_offsets=offsets,
        stretch_weights=weights,
        times=times,
        depth=depth,
        explained=fit.explained,
        unshifted=_Fit(way, times, depth).explained,
    )


def _way(times: Array, arm_times: Array, position: Array) -> CubicSpline:
    """Where the arm is along the sensor's axis, over time; zero in the middle of its way."""
    during = (arm_times >= times[0]) & (arm_times <= times[-1])
    way = position - position[during].mean()
    deviation = float(way[during].std())
    if deviation < _LEAST_MOTION:
        raise CalibrationError(
            f"the arm moved along the sensor's axis by {deviation * 1e3:.2f} mm (standard deviation), must "
            f"be at least {_LEAST_MOTION * 1e3:g} mm"
        )
    high, low = way[during] > 0.5 * deviation, way[during] < -0.5 * deviation
    sides = np.where(high, 1, -1)[high | low]
    if int(np.count_nonzero(np.diff(sides))) < _TURNS:
        raise CalibrationError(
            f"the arm came from one side to the other fewer than {_TURNS} times while there was contact"
        )
    return CubicSpline(arm_times, way)


class _Fit:
    """The equation at given times of the arm, by least squares."""

    def __init__(self, way: CubicSpline, times: Array, depth: Array, degree: int = 2) -> None:
        s = way(times)
        basis = np.vander(s, degree + 1, increasing=True)
        a = np.linalg.lstsq(basis, depth, rcond=None)[0]
        self.explained = basis @ a
        self.rest = depth - self.explained
        self.speed = polyval(s, polyder(a)) * way(times, 1)  # of what is explained, m/s
        explained = np.sqrt(max(0.0, 1.0 - self.rest.var() / depth.var()))
        self.correlation = float(np.copysign(explained, a[1]))


def _stretches(fit: _Fit, times: Array, tau: float) -> tuple[Array, Array, Array]:
    """Middle of each stretch, the offset in it (of the residual, what goes with the speed), its weight."""
    edges = np.linspace(times[0], times[-1] + 1e-9, _STRETCHES + 1)
    middles, offsets, weights = [], [], []
    for start, end in itertools.pairwise(edges):
        inside = (times >= start) & (times < end)
        speed, rest = fit.speed[inside], fit.rest[inside]
        if inside.sum() < 5 or speed.std() < 0.2 * fit.speed.std():
            continue  # the arm rested: nothing is told there
        basis = np.column_stack([speed, np.ones_like(speed)])
        offsets.append(tau + float(np.linalg.lstsq(basis, rest, rcond=None)[0][0]))
        middles.append(0.5 * (start + end))
        weights.append(float(speed.var() * len(speed)))
    if len(offsets) < 3:
        raise CalibrationError("the arm moved back and forth for too short a time: ten seconds are enough")
    return np.array(middles), np.array(offsets), np.array(weights) / sum(weights)


def _line(x: Array, y: Array, weights: Array) -> tuple[float, float, float]:
    """Of a line through points of given weights: standard deviation of the mean, slope, and that of it."""
    off = x - weights @ x
    spread = float(weights @ off**2)
    slope = float((weights * off) @ y / spread)
    rest = y - weights @ y - slope * off
    variance = float(weights @ rest**2) / (len(x) - 2)
    return float(np.sqrt(variance)), slope, float(np.sqrt(variance / spread))
