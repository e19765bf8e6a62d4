"""Fusion: C against NumPy, both against 60 digits, its laws, and what it refuses."""

import numpy as np
import pytest
import se3_oracle as oracle
from fusion_cases import extreme_covariance, extreme_mean, in_sigmas, random_pair
from fusion_reference import fuse_exact, fuse_fixed
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_triangular

from tactile_filter import _fusion
from tactile_filter.fusion import MODES, FusionError, FusionStatus, check_gaussian, fuse
from tactile_geometry import se3


def reference(pair, mode):
    if mode == "exact":
        return fuse_exact(*pair)
    return fuse_fixed(*pair, *MODES[mode])


@pytest.mark.parametrize("mode", MODES)
def test_c_agrees_with_numpy_to_twelve_digits(mode):
    for seed in range(40):
        pair = random_pair(seed)
        fused, expected = fuse(*pair, mode), reference(pair, mode)
        assert fused.status == expected.status
        assert in_sigmas(fused.mean, expected.mean, expected.cov) <= 1e-12
        assert np.abs(fused.mean - expected.mean).max() <= 1e-12
        np.testing.assert_allclose(fused.cov, expected.cov, rtol=0, atol=1e-12 * np.abs(expected.cov).max())
        scale = np.sqrt(np.outer(np.diag(expected.cov), np.diag(expected.cov)))
        assert np.abs((fused.cov - expected.cov) / scale).max() <= 1e-12
        np.testing.assert_allclose(fused.factor @ fused.factor.T, fused.cov, rtol=1e-13, atol=1e-30)
        assert fused.step == pytest.approx(expected.step, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("order", [2, 4, "exact"])
@pytest.mark.parametrize("iterations", [1, 2, 10])
def test_iterations_and_order_mean_the_same_in_c_and_numpy(order, iterations):
    pair = random_pair(3, separation=8.0)
    fused = fuse(*pair, iterations=iterations, jacobian_order=order)
    expected = fuse_fixed(*pair, iterations, order)
    assert fused.iterations == iterations
    assert in_sigmas(fused.mean, expected.mean, expected.cov) <= 1e-12


@pytest.mark.parametrize("seed", range(3))
def test_paper_mode_is_the_published_algorithm_in_sixty_digits(seed):
    pair = random_pair(seed, separation=4.0)
    mean, cov, step = oracle.fuse(*pair, iterations=5)
    fused = fuse(*pair)
    mean, cov = oracle.as_double(mean), oracle.as_double(cov)
    assert in_sigmas(fused.mean, mean, cov) <= 1e-12
    scale = np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    assert np.abs((fused.cov - cov) / scale).max() <= 1e-13
    last = np.linalg.norm(np.linalg.solve(np.linalg.cholesky(cov), [float(v) for v in step]))
    assert fused.step == pytest.approx(last, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_exact_mode_is_the_minimum_in_sixty_digits(seed):
    pair = random_pair(seed, separation=10.0)
    mean, cov, _ = oracle.fuse(*pair)
    fused = fuse(*pair, "exact")
    assert fused.status == FusionStatus.CONVERGED
    cov = oracle.as_double(cov)
    assert in_sigmas(fused.mean, oracle.as_double(mean), cov) <= 1e-11
    assert np.abs(fused.cov / cov - 1.0).max() <= 1e-9


def test_fusion_of_pure_translations_is_the_product_of_gaussians():
    rng = np.random.default_rng(1)
    # the same for x, y, z: else a turn would buy a better translation
    cov_1, cov_2 = (np.diag(np.repeat(rng.uniform(1, 4, 2), 3)) for _ in range(2))
    mean_2 = se3.exp([1.0, -2.0, 3.0, 0.0, 0.0, 0.0])
    fused = fuse(np.eye(4), cov_1, mean_2, cov_2, "exact")
    weight_1, weight_2 = 1.0 / np.diag(cov_1), 1.0 / np.diag(cov_2)
    np.testing.assert_allclose(fused.mean[:3, 3], (weight_2 / (weight_1 + weight_2))[:3] * [1.0, -2.0, 3.0])


def test_equal_inputs_keep_the_mean_and_halve_the_covariance():
    mean, cov, _, _ = random_pair(5)
    for mode in MODES:
        fused = fuse(mean, cov, mean, cov, mode)
        np.testing.assert_allclose(fused.mean, mean, atol=1e-13)
        np.testing.assert_allclose(fused.cov, 0.5 * cov, atol=1e-13 * cov.max())


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.0, 10.0))
def test_at_convergence_the_order_of_the_inputs_does_not_matter(seed, separation):
    mean_1, cov_1, mean_2, cov_2 = random_pair(seed, separation)
    one, other = fuse(mean_1, cov_1, mean_2, cov_2, "exact"), fuse(mean_2, cov_2, mean_1, cov_1, "exact")
    assert one.status == other.status == FusionStatus.CONVERGED
    assert in_sigmas(one.mean, other.mean, one.cov) <= 1e-8
    np.testing.assert_allclose(one.cov, other.cov, atol=1e-8 * np.abs(one.cov).max())


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6))
def test_fusion_does_not_depend_on_the_frame(seed):
    mean_1, cov_1, mean_2, cov_2 = random_pair(seed)
    rng = np.random.default_rng(seed)
    T = se3.exp(np.concatenate((0.05 * rng.normal(size=3), rng.normal(size=3))))
    Ad = se3.adjoint(T)
    moved = fuse(T @ mean_1, Ad @ cov_1 @ Ad.T, T @ mean_2, Ad @ cov_2 @ Ad.T, "exact")
    here = fuse(mean_1, cov_1, mean_2, cov_2, "exact")
    assert in_sigmas(moved.mean, T @ here.mean, moved.cov) <= 1e-8
    np.testing.assert_allclose(moved.cov, Ad @ here.cov @ Ad.T, rtol=0, atol=1e-8 * np.abs(moved.cov).max())


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("variances", [(1e-12, 1e12), (1e-12, 1e-12), (1e12, 1e12), (1e12, 1e-12)])
def test_extreme_variances_give_a_positive_definite_answer_near_the_certain_input(mode, variances):
    rng = np.random.default_rng(7)
    pose = se3.exp(0.3 * rng.normal(size=6))
    other = se3.exp(1e-7 * rng.normal(size=6)) @ pose
    fused = fuse(pose, variances[0] * np.eye(6), other, variances[1] * np.eye(6), mode)
    np.linalg.cholesky(fused.cov)
    assert (np.diag(fused.factor) > 0.0).all()
    certain = other if variances[1] < variances[0] else pose
    assert in_sigmas(fused.mean, certain, fused.cov) <= 1.0


def test_graded_variances_over_24_decades_within_one_matrix():
    cov = np.diag([1e-12, 1e12, 1.0, 1e-6, 1e6, 1e-12])
    fused = fuse(np.eye(4), cov, np.eye(4), cov)
    np.testing.assert_allclose(np.diag(fused.cov), 0.5 * np.diag(cov), rtol=1e-13)


def test_a_fusion_cut_short_says_so():
    mean_1, cov, _, _ = random_pair(9)
    mean_2 = se3.exp([0.0, 0.0, 0.0, 1.5, 1.0, -1.0]) @ mean_1
    assert fuse(mean_1, cov, mean_2, cov, iterations=1).status == FusionStatus.NOT_CONVERGED
    assert fuse(mean_1, cov, mean_2, cov, "exact", iterations=1).status == FusionStatus.NOT_CONVERGED


def test_exact_mode_finds_a_stationary_point_from_far_apart():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        mean_2 = se3.exp(np.concatenate((rng.normal(size=3), 0.8 * rng.normal(size=3))))
        fused = fuse(
            np.eye(4), np.diag(rng.uniform(0.5, 1, 6)), mean_2, np.diag(rng.uniform(0.5, 1, 6)), "exact"
        )
        assert fused.status == FusionStatus.CONVERGED
        assert fused.step <= 1e-8


def spoiled(array, index, value):
    result = array.copy()
    result[index] = value
    return result


@pytest.mark.parametrize(
    ("which", "spoil", "message"),
    [
        (0, lambda m: spoiled(m, (0, 3), np.nan), "mean_1: is not finite"),
        (2, lambda m: spoiled(m, (1, 1), np.inf), "mean_2: is not finite"),
        (0, lambda m: spoiled(m, (3, 0), 1.0), r"mean_1: last row must be \[0, 0, 0, 1\]"),
        (
            2,
            lambda m: m @ np.diag([1.01, 1, 1, 1]),
            r"mean_2: is no pose: R\^T R is off the identity by 0.0201",
        ),
        (2, lambda m: m @ np.diag([-1.0, 1, 1, 1]), "mean_2: is no pose: .* det R = -1"),
        (1, lambda m: spoiled(m, (2, 2), np.nan), "cov_1: is not finite"),
        (3, lambda m: np.full((6, 6), np.inf), "cov_2: is not finite"),
        (
            1,
            lambda m: spoiled(m, (0, 1), m[0, 1] + m[0, 0]),
            r"cov_1: is not symmetric: elements \[0, 1\] and \[1, 0\]",
        ),
        (
            3,
            lambda m: np.diag([1.0, 1, 1, 1, 1, -2]),
            "cov_2: is not positive definite: smallest eigenvalue -2,",
        ),
        (1, lambda m: np.zeros((6, 6)), "cov_1: is not positive definite: smallest eigenvalue 0,"),
        (3, lambda m: np.ones((6, 6)), "cov_2: is not positive definite: smallest eigenvalue"),
    ],
)
def test_inputs_that_are_no_gaussian_are_named_with_their_fault(which, spoil, message):
    pair = list(random_pair(11))
    pair[which] = spoil(pair[which])
    with pytest.raises(FusionError, match=message):
        fuse(*pair)


def test_a_gaussian_is_checked_under_the_callers_name():
    check_gaussian(np.eye(4), np.eye(6), "estimate")
    with pytest.raises(
        FusionError, match="estimate, covariance: is not positive definite: smallest eigenvalue -1,"
    ):
        check_gaussian(np.eye(4), -np.eye(6), "estimate")


def test_wrong_shapes_and_options_are_named():
    pair = random_pair(12)
    with pytest.raises(ValueError, match=r"cov_1: must have shape \(6, 6\)"):
        fuse(pair[0], np.eye(5), pair[2], pair[3])
    with pytest.raises(ValueError, match=r"unknown name 'papper' .did you mean 'paper'"):
        fuse(*pair, "papper")
    with pytest.raises(ValueError, match="iterations = 0: must be"):
        fuse(*pair, iterations=0)
    with pytest.raises(ValueError, match="jacobian_order = 3: must be one of 2, 4, 'exact'"):
        fuse(*pair, jacobian_order=3)
    with pytest.raises(ValueError, match="mode 'exact' needs the exact one"):
        fuse(*pair, "exact", jacobian_order=2)


def test_lists_float32_and_strided_arrays_are_taken_as_well():
    pair = random_pair(13)
    expected = fuse(*pair)
    fused = fuse(
        pair[0].tolist(), pair[1].tolist(), np.asfortranarray(pair[2]), np.repeat(pair[3], 2, 1)[:, ::2]
    )
    np.testing.assert_array_equal(fused.mean, expected.mean)
    single = fuse(np.eye(4, dtype=np.float32), np.eye(6, dtype=np.float32), np.eye(4), np.eye(6))
    np.testing.assert_allclose(single.cov, 0.5 * np.eye(6), atol=1e-13)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused_wherever_it_stands(mode, value):
    names = ("mean_1", "cov_1", "mean_2", "cov_2")
    for which, array in enumerate(random_pair(3)):
        for index in np.ndindex(array.shape):
            pair = list(random_pair(3))
            pair[which] = spoiled(array, index, value)
            if array.shape == (6, 6):
                pair[which][index[::-1]] = value
            with pytest.raises(FusionError, match=f"{names[which]}: is not finite"):
                fuse(*pair, mode)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("scale", [1e-290, 1e-150, 1e-30, 1e30, 1e150, 1e290])
def test_beyond_all_reason_the_answer_is_still_finite_and_positive_definite(mode, scale):
    mean, cov_1, _, cov_2 = random_pair(5)
    for scale_1, scale_2 in ((scale, 1.0), (1.0, scale), (scale, scale), (scale, 1.0 / scale)):
        fused = fuse(mean, scale_1 * cov_1, mean, scale_2 * cov_2, mode)
        np.testing.assert_allclose(fused.mean, mean, atol=1e-13)
        assert np.isfinite(fused.cov).all()
        assert (np.diag(fused.factor) > 0.0).all()


def test_every_instruction_set_of_this_machine_fuses_alike():
    best = _fusion.instruction_set()
    for seed in range(24):
        pair = random_pair(seed, 4.0)
        _fusion.instruction_set("base")
        base = fuse(*pair)
        _fusion.instruction_set(best)
        other = fuse(*pair)
        assert in_sigmas(base.mean, other.mean, base.cov) <= 1e-12


def test_an_instruction_set_that_is_not_there_is_named():
    with pytest.raises(ValueError, match="instruction set 'mmx': this machine does not have it"):
        _fusion.instruction_set("mmx")


@pytest.mark.parametrize("mode", MODES)
def test_errors_of_fused_poses_are_as_large_as_their_covariances_claim(mode):
    rng, count = np.random.default_rng(4), 20000
    truth, cov_1, _, cov_2 = random_pair(1)
    drawn = [rng.normal(size=(count, 6)) @ np.linalg.cholesky(cov).T for cov in (cov_1, cov_2)]
    whitened = np.empty((count, 6))
    for n, (eps_1, eps_2) in enumerate(zip(*drawn, strict=True)):
        # truth = exp(eps^) mean
        fused = fuse(se3.exp(-eps_1) @ truth, cov_1, se3.exp(-eps_2) @ truth, cov_2, mode)
        error = se3.log(truth @ se3.inverse(fused.mean))
        whitened[n] = solve_triangular(fused.factor, error, lower=True)
    # standard normal: the mean square of 20000 is 1 within 1 %, correlations vanish
    np.testing.assert_allclose(whitened.T @ whitened / count, np.eye(6), atol=0.045)
    assert (whitened**2).sum(axis=1).mean() == pytest.approx(6.0, abs=0.1)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # the numbers in a refusal may be infinite
@pytest.mark.parametrize("mode", MODES)
def test_whatever_the_matrices_the_answer_is_finite_or_a_refusal(mode):
    rng, answers = np.random.default_rng(5), 0
    for _ in range(3000):
        try:
            fused = fuse(*(make(rng) for make in 2 * (extreme_mean, extreme_covariance)), mode)
        except FusionError:
            continue
        answers += 1
        assert all(np.isfinite(part).all() for part in (fused.mean, fused.cov, fused.factor))
    assert answers > 20


@pytest.mark.parametrize(
    ("distance", "variance", "complaint"),
    [
        (2e9, 1.0, r"estimate, mean: is further away than 1e9 m"),
        (0.0, 1e20, r"estimate, covariance: has variances outside \[1e-30, 1e18\]"),
        (0.0, 1e-40, r"estimate, covariance: has variances outside \[1e-30, 1e18\]"),
    ],
)
def test_a_filter_takes_nothing_that_further_steps_may_overflow_with(distance, variance, complaint):
    with pytest.raises(FusionError, match=complaint):
        check_gaussian(se3.exp([distance, 0, 0, 0, 0, 0]), variance * np.eye(6), "estimate")
