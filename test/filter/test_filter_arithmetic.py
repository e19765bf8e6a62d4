"""One step's arithmetic against the same in plain NumPy, and what counts as a pose."""

import numpy as np
import pytest
import step_reference as reference
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_filter import filter_arithmetic as arithmetic
from tactile_filter import se3

angles = st.floats(0.0, 3.1)
seeds = st.integers(0, 2**32 - 1)


def random_pose(rng, angle, reach=0.5):
    axis = rng.normal(size=3)
    return se3.exp(np.concatenate((reach * rng.normal(size=3), angle * axis / np.linalg.norm(axis))))


def random_cov(rng, decades=2.0):
    Q, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    sigma = 10.0 ** rng.uniform(-decades, 0.0, 6)
    cov = (Q * sigma**2) @ Q.T
    return 0.5 * (cov + cov.T)


@settings(max_examples=200, deadline=None)
@given(seeds, angles)
def test_prediction_is_the_plain_one(seed, angle):
    rng = np.random.default_rng(seed)
    mean, before, now = random_pose(rng, angle), random_pose(rng, angle), random_pose(rng, 1.0)
    cov, variances = random_cov(rng), rng.uniform(0.0, 1e-3, 6)
    expected_mean, expected_cov = reference.predict(mean, cov, before, now, variances)
    found_mean, found_cov = arithmetic.predict(mean, cov, before, now, variances)
    np.testing.assert_allclose(found_mean, expected_mean, rtol=0, atol=4e-15)
    np.testing.assert_allclose(found_cov, expected_cov, rtol=0, atol=1e-12 * np.abs(expected_cov).max())
    np.testing.assert_array_equal(found_cov, found_cov.T)


@settings(max_examples=200, deadline=None)
@given(seeds, angles)
def test_innovation_without_jacobians_is_that_with_them(seed, angle):
    rng = np.random.default_rng(seed)
    mean_bel = random_pose(rng, 2.0)
    mean_obs = random_pose(rng, angle) @ mean_bel
    cov_obs, cov_bel = random_cov(rng, 1.0), random_cov(rng, 1.0)
    expected = reference.innovation_squared(mean_obs, cov_obs, mean_bel, cov_bel)
    found = arithmetic.innovation(mean_obs, cov_obs, mean_bel, cov_bel)
    assert found.nis == pytest.approx(expected, rel=1e-11)
    assert found.nis == pytest.approx(float(found.whitened @ found.whitened), rel=1e-14)


def test_whitened_innovations_are_standard_normal():
    rng = np.random.default_rng(5)
    cov_obs, cov_bel = 1e-4 * random_cov(rng), 1e-4 * random_cov(rng)
    factor_obs, factor_bel = np.linalg.cholesky(cov_obs), np.linalg.cholesky(cov_bel)
    truth = random_pose(rng, 1.0)
    draws = np.array(
        [
            arithmetic.innovation(
                se3.exp(factor_obs @ rng.normal(size=6)) @ truth, cov_obs,
                se3.exp(factor_bel @ rng.normal(size=6)) @ truth, cov_bel,
            ).whitened
            for _ in range(4000)
        ]
    )  # fmt: skip
    np.testing.assert_allclose(draws.mean(axis=0), 0.0, atol=4.5 / np.sqrt(4000))
    np.testing.assert_allclose(np.cov(draws.T), np.eye(6), atol=6.0 / np.sqrt(4000))


def test_an_innovation_that_no_covariance_allows_is_infinite():
    found = arithmetic.innovation(np.eye(4), np.zeros((6, 6)), np.eye(4), np.zeros((6, 6)))
    assert found.nis == np.inf


@pytest.mark.parametrize(
    "T",
    [
        np.full((4, 4), np.nan),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.diag([1.0, 1.0, 1.1, 1.0]),
        np.eye(3),
        np.diag([1.0, 1.0, 1.0, 2.0]),
        np.array([[1, 0, 0, np.inf], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]),
    ],
)
def test_what_is_no_pose_is_not_used(T):
    assert arithmetic.usable_pose(T) is None


def test_a_pose_off_orthonormal_by_float32_rounding_is_put_right():
    T = se3.exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]).astype(np.float32)
    usable = arithmetic.usable_pose(T)
    assert np.abs(usable[:3, :3].T @ usable[:3, :3] - np.eye(3)).max() < 1e-15


def test_the_pose_that_is_kept_does_not_change_with_the_callers_array():
    T = np.eye(4)
    usable = arithmetic.usable_pose(T)
    T[0, 3] = 1.0
    assert usable[0, 3] == 0.0
