"""Whole steps of the filter against plain NumPy, and against the same at the extremes."""

import math

import numpy as np
import pytest
import step_reference as reference
from contact_case import CONTACT, SIGMA
from fusion_reference import fuse_fixed
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from tactile_filter.bayes_filter import BeliefFlag, ContactFilter, FilterSettings, gate_threshold
from tactile_filter.fusion import MODES
from tactile_filter.propagation import innovation
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

PERIOD = 8_000_000
UNGATED = FilterSettings(gate_probability=1.0)
VARIANCES = np.repeat((UNGATED.process_noise_translation**2, UNGATED.process_noise_rotation**2), 3)
seeds = st.integers(0, 2**32 - 1)


def random_cov(rng, scale=SIGMA):
    A = rng.normal(size=(6, 9))
    return np.outer(scale, scale) * (A @ A.T) / 9


def random_pose(rng, angle, reach=0.5):
    axis = rng.normal(size=3)
    return se3.exp(np.concatenate((reach * rng.normal(size=3), angle * axis / np.linalg.norm(axis))))


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(0.0, 3.0))
def test_steps_are_those_of_plain_numpy(seed, angle):
    rng = np.random.default_rng(seed)
    contact_filter = ContactFilter(UNGATED)
    contact, sensor = random_pose(rng, 2.0, 0.05), random_pose(rng, angle)
    mean = cov = before = None
    for k in range(8):
        sensor = se3.orthonormalized(sensor @ se3.exp(2e-3 * rng.normal(size=6)))
        estimate = PoseGaussian(se3.exp(SIGMA * rng.normal(size=6)) @ contact, random_cov(rng))
        belief = contact_filter.step(k * PERIOD, estimate, sensor)
        if k == 0:
            mean, cov = estimate.mean, estimate.cov
        else:
            mean, cov = reference.predict(mean, cov, before, sensor, VARIANCES)
            nis = reference.innovation_squared(estimate.mean, estimate.cov, mean, cov)
            assert belief.nis == pytest.approx(nis, rel=1e-10)
            fused = fuse_fixed(estimate.mean, estimate.cov, mean, cov, 5, 2)
            mean, cov = fused.mean, fused.cov
        before = sensor
        deviation = np.sqrt(np.diag(cov))
        assert np.abs(se3.log(belief.mean @ se3.inverse(mean)) / deviation).max() < 1e-12
        assert np.abs((belief.cov - cov) / np.outer(deviation, deviation)).max() < 1e-12


def test_whitened_innovations_of_the_filter_are_standard_normal_and_sum_up_to_nis():
    rng = np.random.default_rng(5)
    cov_obs, cov_bel = random_cov(rng), random_cov(rng)
    factor_obs, factor_bel = np.linalg.cholesky(cov_obs), np.linalg.cholesky(cov_bel)
    draws = []
    for _ in range(4000):
        observed = se3.exp(factor_obs @ rng.normal(size=6)) @ CONTACT
        believed = se3.exp(factor_bel @ rng.normal(size=6)) @ CONTACT
        surprise = innovation(observed, cov_obs, believed, cov_bel)
        assert surprise.nis == pytest.approx(surprise.whitened @ surprise.whitened, rel=1e-12)
        draws.append(surprise.whitened)
    np.testing.assert_allclose(np.mean(draws, axis=0), 0.0, atol=4.5 / np.sqrt(4000))
    np.testing.assert_allclose(np.cov(np.array(draws).T), np.eye(6), atol=6.0 / np.sqrt(4000))


# ---- the gate at its extremes ----


@pytest.mark.parametrize("dof", [1, 2, 3, 6, 12])
@pytest.mark.parametrize("probability", [0.5, 0.9, 0.999, 0.999999, 1 - 1e-12])
def test_gate_is_the_chi_square_quantile_by_degrees_of_freedom(probability, dof):
    assert gate_threshold(probability, dof) == pytest.approx(chi2.ppf(probability, dof), rel=1e-6)
    assert gate_threshold(1.0, dof) == math.inf


def started(filter_settings, cov):
    contact_filter = ContactFilter(filter_settings)
    contact_filter.step(0, PoseGaussian(CONTACT, cov), np.eye(4))
    return contact_filter


def moved_by_nis(contact_filter, cov, nis):
    """An estimate whose NIS against the filter's next prediction is this."""
    predicted = contact_filter.predict_to(PERIOD, np.eye(4))
    sigma = math.sqrt(cov[0, 0] + predicted.cov[0, 0])
    return PoseGaussian(se3.exp([math.sqrt(nis) * sigma, 0, 0, 0, 0, 0]) @ predicted.mean, cov)


@pytest.mark.parametrize("variance", [1e-12, 1e-4, 1e4])
def test_just_inside_the_gate_is_fused_and_just_outside_is_not(variance):
    gate = gate_threshold(0.999999)
    cov = variance * np.eye(6)
    cov[3:, 3:] = min(variance, 1e-4) * np.eye(3)
    for factor, fused in ((1.0 - 1e-6, True), (1.0 + 1e-6, False)):
        contact_filter = started(FilterSettings(), cov)
        # without lever arms, so that position and rotation stay apart
        contact_filter.reset("start")
        contact_filter.step(0, PoseGaussian(np.eye(4), cov), np.eye(4))
        belief = contact_filter.step(PERIOD, moved_by_nis(contact_filter, cov, factor * gate), np.eye(4))
        assert bool(belief.flags & BeliefFlag.MEASUREMENT_FUSED) == fused
        assert bool(belief.flags & BeliefFlag.GATED) != fused
        assert belief.nis == pytest.approx(factor * gate, rel=1e-6)
        assert belief.nis_dof == 6


def test_turned_by_pi_is_an_outlier_and_after_enough_of_them_the_new_belief():
    contact_filter = started(FilterSettings(reinitialize_after=2), np.diag(SIGMA**2))
    turned = PoseGaussian(se3.exp([0, 0, 0, 0, 0, math.pi]) @ CONTACT, np.diag(SIGMA**2))
    flags = [contact_filter.step(k * PERIOD, turned, np.eye(4)).flags for k in (1, 2, 3, 4)]
    assert [bool(f & BeliefFlag.GATED) for f in flags] == [True, True, False, False]
    assert flags[2] & BeliefFlag.REINITIALIZED
    assert flags[3] == BeliefFlag.MEASUREMENT_FUSED


def test_refusals_in_a_row_are_counted_anew_after_a_measurement_that_fits():
    contact_filter = started(FilterSettings(reinitialize_after=2), np.diag(SIGMA**2))
    good = PoseGaussian(CONTACT, np.diag(SIGMA**2))
    wild = PoseGaussian(se3.exp([0.05, 0, 0, 0, 0, 0]) @ CONTACT, np.diag(SIGMA**2))
    for k, estimate in enumerate((wild, wild, good, wild, wild), 1):
        belief = contact_filter.step(k * PERIOD, estimate, np.eye(4))
        assert bool(belief.flags & BeliefFlag.MEASUREMENT_FUSED) == (estimate is good)
    assert contact_filter.rejections == {"outlier": 4}
    assert not contact_filter.resets


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid")
@pytest.mark.parametrize("reach", [1e100, 1e160, 1e300])
def test_a_sensor_at_absurd_distances_never_stops_the_filter(reach):
    contact_filter = ContactFilter(UNGATED)
    good = PoseGaussian(CONTACT, np.diag(SIGMA**2))
    far = np.eye(4)
    far[0, 3] = reach
    for k in range(12):
        belief = contact_filter.step(k * PERIOD, good, far if k % 3 == 1 else np.eye(4))
        assert belief.valid == bool(np.isfinite(belief.cov).all() and np.isfinite(belief.mean).all())
        ahead = contact_filter.predict_to(k * PERIOD + 1, -far @ np.diag([-1, -1, -1, -1.0]))
        assert ahead.valid == bool(np.isfinite(ahead.cov).all())
    contact_filter.reset("back")
    assert contact_filter.step(13 * PERIOD, good, np.eye(4)).valid


def test_a_million_to_one_measurement_against_a_certain_belief_keeps_its_place():
    cov = np.diag(SIGMA**2)
    contact_filter = started(
        UNGATED.replaced(process_noise_translation=0.0, process_noise_rotation=0.0), 1e-12 * cov
    )
    vague = PoseGaussian(se3.exp(SIGMA) @ CONTACT, 1e6 * cov)
    belief = contact_filter.step(PERIOD, vague, np.eye(4))
    assert np.abs(se3.log(belief.mean @ se3.inverse(CONTACT)) / SIGMA).max() < 1e-9


@pytest.mark.parametrize("mode", MODES)
def test_tens_of_thousands_of_steps_with_motion_stay_on_the_group_and_positive_definite(mode):
    rng = np.random.default_rng(3)
    contact_filter = ContactFilter(FilterSettings(fusion_mode=mode, robust="none"))
    sensors = [np.eye(4)]
    for twist in 1e-3 * rng.normal(size=(63, 6)):
        sensors.append(se3.orthonormalized(sensors[-1] @ se3.exp(twist)))
    estimates = [
        PoseGaussian(se3.exp(SIGMA * rng.normal(size=6)) @ CONTACT, random_cov(rng) + np.diag(SIGMA**2))
        for _ in range(61)
    ]
    for k in range(60_000):
        belief = contact_filter.step(k * PERIOD, estimates[k % 61], sensors[abs(63 - k % 126)])
    R = belief.mean[:3, :3]
    assert np.abs(R.T @ R - np.eye(3)).max() < 1e-13
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-13)
    np.testing.assert_array_equal(belief.cov, belief.cov.T)
    deviation = np.sqrt(np.diag(belief.cov))
    assert np.linalg.eigvalsh(belief.cov / np.outer(deviation, deviation))[0] > 1e-3
    assert np.abs(se3.log(belief.mean @ se3.inverse(CONTACT)) / SIGMA).max() < 50


# ---- what the choice of frames must not change ----


def run_moved(G, A, seed=4):
    """Beliefs with the base moved by G and the sensor's frame by A, without process noise."""
    rng = np.random.default_rng(seed)
    still = UNGATED.replaced(process_noise_translation=0.0, process_noise_rotation=0.0, fusion_mode="exact")
    contact_filter, sensor = ContactFilter(still), random_pose(rng, 1.0)
    beliefs = []
    for k in range(10):
        sensor = sensor @ se3.exp(2e-3 * rng.normal(size=6))
        mean, cov = se3.exp(SIGMA * rng.normal(size=6)) @ CONTACT, random_cov(rng)
        adjoint = se3.adjoint(A)
        estimate = PoseGaussian(A @ mean, adjoint @ cov @ adjoint.T)
        beliefs.append(contact_filter.step(k * PERIOD, estimate, G @ sensor @ se3.inverse(A)))
    return beliefs


@settings(max_examples=20, deadline=None)
@given(seeds, st.floats(0.0, 3.1))
def test_where_the_base_is_does_not_matter(seed, angle):
    G = random_pose(np.random.default_rng(seed), angle, 2.0)
    for moved, plain in zip(run_moved(G, np.eye(4)), run_moved(np.eye(4), np.eye(4)), strict=True):
        deviation = np.sqrt(np.diag(plain.cov))
        assert np.abs(se3.log(moved.mean @ se3.inverse(plain.mean)) / deviation).max() < 1e-9
        assert np.abs((moved.cov - plain.cov) / np.outer(deviation, deviation)).max() < 1e-9


@settings(max_examples=20, deadline=None)
@given(seeds, st.floats(0.0, 3.1))
def test_another_frame_of_the_sensor_gives_the_same_belief_in_it(seed, angle):
    A = random_pose(np.random.default_rng(seed), angle, 0.05)
    adjoint = se3.adjoint(se3.inverse(A))
    for moved, plain in zip(run_moved(np.eye(4), A), run_moved(np.eye(4), np.eye(4)), strict=True):
        deviation = np.sqrt(np.diag(plain.cov))
        error = se3.log(se3.inverse(A) @ moved.mean @ se3.inverse(plain.mean)) / deviation
        assert np.abs(error).max() < 1e-8
        back = adjoint @ moved.cov @ adjoint.T
        assert np.abs((back - plain.cov) / np.outer(deviation, deviation)).max() < 1e-8
        if plain.nis_dof:
            assert moved.nis == pytest.approx(plain.nis, rel=1e-7)
