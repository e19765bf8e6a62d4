"""Prediction and innovation in C against NumPy written from the formulas."""

import math

import numpy as np
import pytest
import se3_reference
import step_reference as reference

from tactile_filter.propagation import innovation, predict
from tactile_geometry import se3
from tactile_geometry.se3 import usable_pose


def random_case(seed):
    rng = np.random.default_rng(seed)
    poses = [se3.exp(rng.normal(size=6)) for _ in range(3)]
    covs = [0.01 * A @ A.T + 1e-4 * np.eye(6) for A in rng.normal(size=(2, 6, 6))]
    return poses, covs, rng.uniform(0, 1e-3, 6)


@pytest.mark.parametrize("seed", range(10))
def test_prediction_is_the_formula_and_symmetric(seed):
    (mean, before, now), (cov, _), variances = random_case(seed)
    moved, moved_cov = predict(mean, cov, before, now, variances)
    expected, expected_cov = reference.predict(mean, cov, before, now, variances)
    np.testing.assert_allclose(moved, expected, atol=1e-13)
    np.testing.assert_allclose(moved_cov, expected_cov, rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(moved_cov, moved_cov.T)
    np.testing.assert_allclose(moved[:3, :3].T @ moved[:3, :3], np.eye(3), atol=1e-13)


@pytest.mark.parametrize("seed", range(10))
def test_innovation_is_the_formula(seed):
    (mean, other, _), (cov, other_cov), _ = random_case(seed)
    nis, whitened, dof = innovation(mean, cov, other, other_cov)
    assert dof == 6
    assert nis == pytest.approx(reference.innovation_squared(mean, cov, other, other_cov), rel=1e-11)
    D = mean @ np.linalg.inv(other)
    L = np.linalg.cholesky(cov + se3.adjoint(D) @ other_cov @ se3.adjoint(D).T)
    np.testing.assert_allclose(whitened, np.linalg.solve(L, se3_reference.log(D)), rtol=1e-9)


def test_innovation_of_something_that_is_no_covariance_is_infinite():
    nis, whitened, _ = innovation(np.eye(4), -np.eye(6), np.eye(4), np.zeros((6, 6)))
    assert nis == math.inf
    assert np.isinf(whitened).all()


def test_a_prediction_without_motion_and_noise_changes_nothing_but_rounding():
    (mean, before, _), (cov, _), _ = random_case(3)
    moved, moved_cov = predict(mean, cov, before, before, np.zeros(6))
    np.testing.assert_allclose(moved_cov, cov, atol=1e-13)
    np.testing.assert_allclose(moved, mean, atol=1e-13)


def test_a_pose_is_usable_as_it_is_or_orthonormalized_or_not_at_all():
    T = se3.exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(usable_pose(T), T)
    noisy = T.copy()
    noisy[0, 0] += 1e-8
    np.testing.assert_array_equal(usable_pose(noisy), se3.orthonormalized(noisy))
    for bad in (
        np.full((4, 4), np.nan),
        2.0 * T,
        np.eye(3),
        np.diag([1.0, 1, -1, 1]),
        np.diag([1.0, 1, 1.1, 1]),
    ):
        assert usable_pose(bad) is None


@pytest.mark.parametrize(
    ("index", "value", "message"),
    [
        (0, np.full((4, 4), np.nan), "mean: must be finite"),
        (2, 2.0 * np.eye(4), r"T_before: last row must be \[0, 0, 0, 1\]"),
        (3, np.diag([1.1, 1, 1, 1]), r"T_now: its rotation is not orthonormal, R\^T R .* by 0.21"),
        (1, np.eye(5), r"cov: must have shape \(6, 6\), has \(5, 5\)"),
        (4, np.full(6, np.inf), "variances: must be finite"),
    ],
)
def test_bad_arguments_are_named(index, value, message):
    arguments = [np.eye(4), np.eye(6), np.eye(4), np.eye(4), np.ones(6)]
    arguments[index] = value
    with pytest.raises(ValueError, match=message):
        predict(*arguments)
