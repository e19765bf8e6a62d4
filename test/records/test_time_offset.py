"""The time offset between camera and arm, of constructed motions; refused where they do not show it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_records.calibrating import time_offset
from tactile_records.calibrating.result import CalibrationError
from tactile_records.runs.record import GaussianSeries, PoseSeries, RunRecord


def signals(
    tau=0.0, drift=0.0, noise=3e-5, bend=0.0, seconds=12.0, period=1.0, amplitude=0.0015, rate=60.0,
    arm_rate=125.0, seed=0,
):  # fmt: skip
    """Depths and positions of an arm that swings in contact; exposures are stamped tau (s) too early."""
    random = np.random.default_rng(seed)
    arm_times = np.arange(0.0, seconds + 2.0, 1.0 / arm_rate)
    times = np.arange(1.0, seconds + 1.0, 1.0 / rate)

    def way(t):
        return amplitude * np.sin(2.0 * np.pi * t / period) + 0.3 * amplitude * np.sin(3.7 * t)

    s = way(times + tau + drift * (times - times.mean()))
    depth = 0.003 + 0.8 * s + bend * s**2 + noise * random.normal(size=len(times))
    return times, depth, arm_times, 0.2 + way(arm_times) + 1e-6 * random.normal(size=len(arm_times))


@settings(max_examples=25, deadline=None)
@given(
    tau=st.floats(-0.2, 0.2),
    noise=st.floats(1e-6, 2e-4),
    bend=st.floats(-100.0, 100.0),
    period=st.floats(0.8, 2.0),
    seed=st.integers(0, 1000),
)
def test_an_offset_is_found_again_within_its_uncertainty(tau, noise, bend, period, seed):
    found = time_offset.estimated(*signals(tau, noise=noise, bend=bend, period=period, seed=seed))
    assert abs(found.seconds - tau) < 5.0 * found.sigma + 2e-4
    assert found.sigma < 0.01
    assert found.residual == pytest.approx(noise, rel=0.2, abs=2e-6)


def test_the_uncertainty_is_that_of_repeated_measurements():
    found = [time_offset.estimated(*signals(0.025, noise=1e-4, seed=seed)) for seed in range(20)]
    spread = np.std([one.seconds for one in found])
    assert 0.5 * spread < np.median([one.sigma for one in found]) < 2.0 * spread


def test_clocks_that_drift_apart_are_told():
    found = time_offset.estimated(*signals(0.01, drift=1e-3, seconds=30.0))
    assert found.drift == pytest.approx(1e-3, abs=4.0 * found.drift_sigma)
    assert found.drift_sigma < 1e-4


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"amplitude": 1e-4}, "along the sensor's axis by 0.07 mm .* must be at least 0.3 mm"),
        ({"noise": 3e-3}, "correlation of no more than 0.[0-9]+, must be 0.9"),
        ({"period": 20.0, "seconds": 10.0}, "fewer than 4 times|too short"),
        ({"seconds": 1.2}, "cover 7[0-9] estimates .* must be at least 100"),
        ({"tau": 0.32, "noise": 1e-6}, "not within 0.3 s"),
    ],
)
def test_what_does_not_tell_an_offset_is_refused_with_what_would(changes, words):
    with pytest.raises(CalibrationError, match=words):
        time_offset.estimated(*signals(**changes))


def test_depth_and_way_are_taken_from_a_run_whichever_way_the_sensor_points():
    times, depth, arm_times, way = signals(-0.025)
    T = np.tile(np.eye(4), (len(arm_times), 1, 1))
    T[:, :3, :3] = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]  # z of the sensor along x of the base
    T[:, 0, 3] = way
    X_sf = np.tile(np.eye(4), (len(times), 1, 1))
    X_sf[:, 2, 3] = -depth
    cov = 1e-8 * np.eye(6)
    record = RunRecord(
        pose=PoseSeries((arm_times * 1e9).astype(int) + 10**9, T),
        estimate=GaussianSeries((times * 1e9).astype(int) + 10**9, X_sf, np.tile(cov, (len(times), 1, 1))),
    )
    assert time_offset.of_record(record).seconds == pytest.approx(-0.025, abs=5e-4)


def test_a_run_without_estimates_is_refused():
    with pytest.raises(CalibrationError, match="0 estimates in contact and 0 poses"):
        time_offset.of_record(RunRecord())
