"""Consistency: the filter keeps it where its assumptions hold, and the monitor tells where they do not."""

import numpy as np
import pytest
from contact_case import CONTACT, SIGMA
from scipy.stats import chi2

from tactile_filter.bayes_filter import ContactFilter, FilterSettings
from tactile_filter.belief import Belief, BeliefFlag
from tactile_filter.consistency import ConsistencyMonitor, ConsistencySettings, nees
from tactile_filter.fusion import MODES
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

PERIOD = 8_000_000
NOISE = np.repeat((2e-4, 4e-3), 3)
SETTINGS = FilterSettings(
    process_noise_translation=2e-4, process_noise_rotation=4e-3, gate_probability=1.0, fusion_mode="fast"
)


def runs(steps, seed, settings=SETTINGS, noise=NOISE, sigma=SIGMA):
    """Truth and belief of each step of a filter over a moving sensor."""
    rng = np.random.default_rng(seed)
    contact_filter = ContactFilter(settings)
    sensor, truth = se3.exp([0.3, 0.2, 0.1, 0.0, 3.0, 0.5]), CONTACT
    for k in range(steps):
        moved = se3.orthonormalized(sensor @ se3.exp([2e-4, 0, 1e-5, 2e-3, 1e-3, 2e-3]))
        if k:
            truth = se3.exp(noise * rng.normal(size=6)) @ se3.inverse(moved) @ sensor @ truth
        sensor = moved
        estimate = PoseGaussian(se3.exp(sigma * rng.normal(size=6)) @ truth, np.diag(SIGMA**2))
        yield truth, contact_filter.step(k * PERIOD, estimate, sensor)


@pytest.mark.parametrize("mode", MODES)
def test_over_many_runs_nees_and_nis_lie_within_their_chi_square_intervals(mode):
    count, at = 60, (0, 5, 20)
    totals, innovations = np.zeros(len(at)), []
    for seed in range(count):
        for k, (truth, belief) in enumerate(runs(21, 1000 + seed, SETTINGS.replaced(fusion_mode=mode))):
            if k in at:
                totals[at.index(k)] += nees(truth, belief.mean, belief.cov)
            if k:
                innovations.append(belief.innovation)
    low, high = chi2.ppf((0.0005, 0.9995), 6 * count)
    assert (totals > low).all()
    assert (totals < high).all()
    squares = np.square(innovations)
    low, high = chi2.ppf((0.0005, 0.9995), squares.size)
    assert low < squares.sum() < high


def monitored(steps, seed, settings=None, **simulation):
    monitor = ConsistencyMonitor(settings or ConsistencySettings(patience=0.0))
    for _, belief in runs(steps, seed, **simulation):
        monitor.add(belief)
    return monitor


def test_a_consistent_filter_is_inside_the_bounds():
    report = monitored(400, 1).report()
    assert report.count == 240
    assert report.nis_bounds[0] < report.nis < report.nis_bounds[1]
    assert report.whiteness < report.whiteness_bound
    assert report.problems == ()


def test_false_alarms_are_as_rare_as_the_setting_says():
    rng = np.random.default_rng(2)
    settings = ConsistencySettings(window=50, probability=0.9, patience=0.0)
    reported = 0
    for _ in range(300):
        monitor = ConsistencyMonitor(settings)
        for k in range(50):
            w = rng.normal(size=6)
            monitor.add(Belief(k, np.eye(4), np.eye(6), float(w @ w), 6, innovation=w))
        reported += bool(monitor.report().problems)
    # two statistics, 10 % each
    assert reported / 300 == pytest.approx(0.19, abs=0.08)


@pytest.mark.parametrize(
    ("simulation", "problem"),
    [
        ({"sigma": 1.5 * SIGMA}, "overconfident: mean NIS / 6 is"),
        ({"sigma": 0.5 * SIGMA}, "underconfident: mean NIS / 6 is"),
        ({"noise": 6.0 * NOISE}, "innovations are correlated"),
    ],
)
def test_what_does_not_hold_is_told(simulation, problem):
    report = monitored(400, 3, **simulation).report()
    assert any(problem in text for text in report.problems), report.problems
    harmful = any("overconfident:" in text and "under" not in text for text in report.problems)
    assert bool(report.warnings) == harmful


def test_all_can_be_warned_of():
    settings = ConsistencySettings(patience=0.0, warn_of="all")
    report = monitored(400, 3, settings, sigma=0.5 * SIGMA).report()
    assert report.warnings == report.problems != ()


def test_bounds_are_the_chi_square_quantiles():
    monitor = ConsistencyMonitor(ConsistencySettings(window=100, probability=0.99))
    assert monitor.nis_bounds == pytest.approx(chi2.ppf((0.005, 0.995), 600) / 600, rel=1e-9)
    assert monitor.whiteness_bound == pytest.approx(chi2.ppf(0.99, 6) / 6, rel=1e-9)


def test_only_what_lasts_is_told():
    monitor = ConsistencyMonitor(ConsistencySettings(window=20, patience=0.5))
    reported = []
    for k, (_, belief) in enumerate(runs(200, 4, sigma=2.0 * SIGMA)):
        monitor.add(belief)
        if monitor.report().problems:
            reported.append(k)
    assert reported[0] == pytest.approx(20 + 0.5 / 8e-3, abs=5)


def test_nothing_is_said_before_the_window_is_full_and_after_a_reset():
    monitor = monitored(100, 5, sigma=3.0 * SIGMA)
    assert monitor.report().count == 99
    assert np.isnan(monitor.report().nis)
    assert monitor.report().problems == ()
    monitor = monitored(400, 5, sigma=3.0 * SIGMA)
    assert monitor.report().problems
    monitor.reset()
    assert monitor.report().count == 0
    assert monitor.report().problems == ()


def test_outliers_are_a_matter_of_their_own():
    settings = ConsistencySettings(window=100, patience=0.0)
    monitor = ConsistencyMonitor(settings)
    rng = np.random.default_rng(6)
    for k in range(300):
        w = rng.normal(size=6)
        flags = BeliefFlag.MEASUREMENT_FUSED
        if k % 5 == 0:
            w, flags = 100.0 * w, BeliefFlag.GATED | BeliefFlag.PREDICTED_ONLY
        monitor.add(Belief(k, np.eye(4), np.eye(6), float(w @ w), 6, flags, innovation=w))
    report = monitor.report()
    assert report.rejected == pytest.approx(0.2)
    assert report.problems == ("many outliers: 20% of the measurements refused, more than 5%",)


def test_a_smaller_window_keeps_the_newest_innovations():
    monitor = monitored(400, 7)
    monitor.configure(ConsistencySettings(window=50))
    assert monitor.report().count == 50


def test_nees_of_a_belief_is_the_squared_mahalanobis_distance_of_its_error():
    error = np.array([1e-3, 0, 0, 0, 0, 0])
    assert nees(se3.exp(error) @ CONTACT, CONTACT, np.diag(SIGMA**2)) == pytest.approx(4.0)
