"""Mode "exact" against the minimum in 60 digits, at the extremes."""

import mpmath as mp
import numpy as np
import pytest
import se3_oracle as oracle
from fusion_cases import as_exact, cases, exact_error, rotated, seen_from, tolerance, turned
from fusion_reference import fuse_exact

from tactile_filter.fusion import MODES, FusionError, FusionStatus, fuse
from tactile_geometry import se3

CASES = [(name, seed) for seed in (0, 1) for name in cases(0) if seed == 0 or "degrees" not in name]


@pytest.mark.parametrize(("name", "seed"), CASES)
def test_exact_fusion_is_the_minimum_as_far_as_the_rounding_of_its_inputs_allows(name, seed):
    pair = cases(seed)[name]
    fused = fuse(*pair, "exact")
    assert fused.status == FusionStatus.CONVERGED
    error, cost, _, information = exact_error(pair, fused)
    print(f"\n{name}: error {error:.1e} sigma, rounding the inputs costs {cost:.1e}")
    assert error <= tolerance(cost)
    # the factor says what the covariance is, whatever its condition
    whitened = oracle.matrix(fused.factor).T * information * oracle.matrix(fused.factor)
    assert oracle.worst(whitened, np.eye(6)) <= 1e-6


def test_the_oracle_is_where_the_cost_has_no_slope_and_is_lowest():
    pair = cases(0)["lever apart"]
    fused = fuse(*pair, "exact")
    means, covs = as_exact(pair)
    X, information = oracle.minimum(means, covs, oracle.exact_rotation(fused.mean))
    weights = [cov**-1 for cov in covs]
    here = oracle.mahalanobis_cost(X, means, weights)
    h = mp.mpf(10) ** -18
    sigmas = mp.cholesky(information**-1)
    for k in range(6):
        direction = list(sigmas[:, k])
        there, back = (
            oracle.mahalanobis_cost(oracle.closed_exp([s * h * x for x in direction]) * X, means, weights)
            for s in (1, -1)
        )
        assert abs(there - back) / h <= 1e-12
        assert there + back - 2 * here > 0


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("degrees", [30, 100, 175, 179.9])
def test_far_apart_it_ends_in_one_minimum_from_either_side_with_lever_arms_and_anisotropy(degrees, seed):
    rng = np.random.default_rng(seed)
    mean_1 = se3.exp(0.5 * rng.normal(size=6))
    mean_2 = turned(rng, degrees, 0.05) @ mean_1
    sigmas = np.array([0.05, 0.05, 0.05, 0.5, 0.5, 0.5]) * 10.0 ** rng.uniform(-0.5, 0.5, (2, 6))
    cov_1, cov_2 = (seen_from(0.3 * rng.normal(size=3), np.diag(s**2)) for s in sigmas)
    one, other = fuse(mean_1, cov_1, mean_2, cov_2, "exact"), fuse(mean_2, cov_2, mean_1, cov_1, "exact")
    assert one.status == other.status == FusionStatus.CONVERGED
    distance = np.linalg.norm(np.linalg.solve(one.factor, se3.log(one.mean @ se3.inverse(other.mean))))
    assert distance <= 1e-11


def test_where_gauss_newton_goes_in_circles_newton_does_not():
    # lever arms of 300 mm, sigmas that differ by a factor of 100, separations of hundreds of sigmas
    circles, settled = 0, 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        sigma = np.repeat([1e-3, 0.3], 3) * 10.0 ** rng.uniform(-1, 1, (2, 6))
        mean_1 = se3.exp(np.concatenate((0.3 * rng.normal(size=3), rng.normal(size=3))))
        pair = mean_1, np.diag(sigma[0] ** 2), turned(rng, 60) @ mean_1, np.diag(sigma[1] ** 2)
        plain, exact = fuse(*pair, iterations=100, jacobian_order="exact"), fuse(*pair, "exact")
        assert exact.iterations < 100
        if plain.step > 1e-6:
            circles += 1
            settled += exact.status == FusionStatus.CONVERGED
        else:
            assert exact.status == FusionStatus.CONVERGED
    assert circles >= 10
    assert settled >= 0.6 * circles


def test_a_minimum_at_the_edge_of_the_logarithm_is_told():
    statuses = set()
    for seed in range(400):
        rng = np.random.default_rng(seed)
        sigma = 10.0 ** rng.uniform(-1.5, 1.5, (2, 6))
        mean_2 = turned(rng, 179.9, 1.0)
        fused = fuse(np.eye(4), np.diag(sigma[0] ** 2), mean_2, np.diag(sigma[1] ** 2), "exact")
        assert np.isfinite(fused.mean).all()
        statuses.add(fused.status)
        if fused.status == FusionStatus.CONVERGED:
            assert fused.step <= 1e-8
    assert FusionStatus.STALLED in statuses


@pytest.mark.parametrize("mode", MODES)
def test_past_a_condition_of_1e16_the_factor_still_holds_what_the_covariance_cannot(mode):
    rng = np.random.default_rng(2)
    cov_1, cov_2 = rotated(rng, 15), rotated(rng, 15)
    smallest = min(np.linalg.eigvalsh(cov_1)[0], np.linalg.eigvalsh(cov_2)[0])
    assert smallest > 0.0
    # both know the same five directions far better than the sixth
    cov_2 = cov_1 * 4.0
    fused = fuse(np.eye(4), cov_1, np.eye(4), cov_2, mode)
    exact = (oracle.matrix(cov_1) ** -1 + oracle.matrix(cov_2) ** -1) ** -1
    whitened = oracle.matrix(fused.factor).T * exact**-1 * oracle.matrix(fused.factor)
    assert oracle.worst(whitened, np.eye(6)) <= 0.2
    assert (np.diag(fused.factor) > 0.0).all()


def test_a_covariance_that_is_singular_but_for_rounding_is_decided_in_higher_precision():
    rng = np.random.default_rng(3)
    # 1 - 2^-53 as a correlation: positive definite, by the last bit
    cov = np.eye(6)
    cov[0, 1] = cov[1, 0] = 1.0 - 2.0**-53
    fused = fuse(np.eye(4), cov, np.eye(4), 1e12 * np.eye(6))
    np.testing.assert_allclose(fused.cov[:2, :2], cov[:2, :2], rtol=1e-10)
    assert fused.factor[0, 0] ** 2 == pytest.approx(1.0)
    assert fused.factor[1, 1] ** 2 == pytest.approx(2.0**-52, rel=1e-3)
    cov[0, 1] = cov[1, 0] = 1.0
    with pytest.raises(FusionError, match="cov_1: is not positive definite: smallest eigenvalue"):
        fuse(np.eye(4), cov, np.eye(4), np.eye(6))
    low_rank = rng.normal(size=(6, 3))
    with pytest.raises(FusionError, match="cov_2: is not positive definite: smallest eigenvalue"):
        fuse(np.eye(4), np.eye(6), np.eye(4), np.diag(np.diag(low_rank @ low_rank.T)) * [1, 1, 1, 1, 1, 0])


def test_means_that_are_rotations_only_to_the_tolerance_count_as_the_nearest_rotations():
    pair = list(cases(0)["unit"])
    expected = fuse(*pair, "exact")
    for k in (0, 2):
        pair[k] = pair[k].copy()
        pair[k][:3, :3] = pair[k][:3, :3] @ (np.eye(3) + 1e-7 * np.diag([1.0, -2.0, 3.0]))
    fused = fuse(*pair, "exact")
    R = fused.mean[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-13)
    np.testing.assert_allclose(fused.mean, expected.mean, atol=1e-6)


@pytest.mark.parametrize("name", ["lever apart", "120 degrees", "170 degrees", "graded"])
def test_the_numpy_reference_finds_the_same_minima(name):
    pair = cases(0)[name]
    fused, expected = fuse(*pair, "exact"), fuse_exact(*pair)
    assert expected.status == FusionStatus.CONVERGED
    distance = np.linalg.solve(fused.factor, se3.log(fused.mean @ se3.inverse(expected.mean)))
    assert np.linalg.norm(distance) <= 1e-7
    np.testing.assert_allclose(np.linalg.solve(fused.factor, expected.factor), np.eye(6), atol=1e-6)
