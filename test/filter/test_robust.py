"""Robust corrections against direct minimization and plain matrices, and what they do to heavy tails."""

import numpy as np
import pytest
from contact_case import CONTACT, SIGMA
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from tactile_filter.bayes_filter import BeliefFlag, ContactFilter, FilterSettings
from tactile_filter.robust import Spectrum, huber_inflation, student_t_inflation
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

PERIOD = 8_000_000
seeds = st.integers(0, 2**32 - 1)


def random_cov(rng, scale=1.0):
    A = rng.normal(size=(6, 9))
    return scale * (A @ A.T) / 9


def translated(rng, distance=1.0):
    """Innovation without rotation and covariances in it: there the problem is exactly linear."""
    nu = np.concatenate((distance * rng.normal(size=3), np.zeros(3)))
    R = np.kron(np.diag([1.0, 0.5]), random_cov(rng)[:3, :3] + 0.1 * np.eye(3))
    P = np.kron(np.diag([0.7, 2.0]), random_cov(rng)[:3, :3] + 0.1 * np.eye(3))
    P[3:, 3:] = 1e-30 * np.eye(3)  # no rotation: the adjoint would couple it to the translation
    return nu, R, P


def spectrum(nu, R, P):
    return Spectrum(PoseGaussian(se3.exp(nu), R), np.eye(4), P)


@settings(max_examples=40, deadline=None)
@given(seeds, st.floats(0.5, 3.0), st.floats(0.1, 20.0))
def test_huber_is_the_minimum_of_hubers_cost(seed, threshold, distance):
    nu, R, P = translated(np.random.default_rng(seed), distance)
    kappa = huber_inflation(spectrum(nu, R, P), threshold)
    information, prior = np.linalg.inv(R)[:3, :3], np.linalg.inv(P[:3, :3])

    def cost(x):
        """Of the position x, the prediction being at the origin and the measurement at nu."""
        d = np.sqrt(max((nu[:3] - x) @ information @ (nu[:3] - x), 1e-300))
        return x @ prior @ x / 2 + (d**2 / 2 if d <= threshold else threshold * (d - threshold / 2))

    found = minimize(cost, 0.5 * nu[:3], method="BFGS", options={"gtol": 1e-9}).x
    expected = P[:3, :3] @ np.linalg.solve(P[:3, :3] + kappa * R[:3, :3], nu[:3])
    np.testing.assert_allclose(expected, found, atol=2e-5 * max(1.0, distance))


@settings(max_examples=100, deadline=None)
@given(seeds, st.floats(2.2, 50.0), st.floats(0.0, 30.0))
def test_student_t_is_a_fixed_point_of_variational_bayes(seed, dof, distance):
    nu, R, P = translated(np.random.default_rng(seed), distance)
    kappa = student_t_inflation(spectrum(nu, R, P), dof)
    information = np.linalg.inv(R)
    gain = P @ np.linalg.inv(P + kappa * R)
    residual, posterior = nu - gain @ nu, P - gain @ P
    expected = residual @ information @ residual + np.trace(information @ posterior)
    assert kappa == pytest.approx((dof - 2.0 + expected) / (dof + 6.0), rel=1e-6)


def test_student_t_with_a_certain_prediction_weighs_as_the_likelihood_does():
    """d/dx of -log t is that of a normal with this inflation: (nu + 6) R^-1 r / (nu - 2 + r^T R^-1 r)."""
    R = random_cov(np.random.default_rng(1))
    nu = np.array([1.0, 2.0, -1.0, 0.0, 0.0, 0.0])
    kappa = student_t_inflation(spectrum(nu, R, 1e-14 * np.eye(6)), 5.0)
    assert kappa == pytest.approx((3.0 + nu @ np.linalg.solve(R, nu)) / 11.0, rel=1e-9)


def test_many_degrees_of_freedom_are_the_normal_distribution():
    rng = np.random.default_rng(2)
    nu, R, P = translated(rng)
    assert student_t_inflation(spectrum(nu, R, P), 1e6) == pytest.approx(1.0, abs=1e-3)


def test_an_estimate_that_agrees_is_not_inflated_by_huber():
    rng = np.random.default_rng(3)
    nu, R, P = translated(rng, 0.1)
    assert huber_inflation(spectrum(nu, R, P), 3.55) == 1.0


@pytest.mark.parametrize("robust", ["student_t", "huber"])
@pytest.mark.parametrize("far", [1e2, 1e4, 1e6])
def test_the_farther_an_estimate_the_less_it_moves_the_belief(robust, far):
    rng = np.random.default_rng(4)
    nu, R, P = translated(rng)
    shifts = []
    for distance in (far, 10.0 * far):
        s = spectrum(distance * nu / np.linalg.norm(nu), R, P)
        kappa = student_t_inflation(s, 4.0) if robust == "student_t" else huber_inflation(s, 3.0)
        assert np.isfinite(kappa)
        shifts.append(distance * np.linalg.norm(P @ np.linalg.solve(P + kappa * R, nu)))
    if robust == "student_t":
        assert shifts[1] < 0.2 * shifts[0]  # redescending
    else:
        assert shifts[1] == pytest.approx(shifts[0], rel=0.2)  # a constant pull


@pytest.mark.parametrize("robust", ["student_t", "huber"])
def test_an_innovation_beyond_double_precision_is_refused(robust):
    contact_filter = ContactFilter(FilterSettings(robust=robust, gate_probability=1.0))
    contact_filter.step(0, PoseGaussian(CONTACT, np.diag(SIGMA**2)), np.eye(4))
    wild = PoseGaussian(se3.exp([1e160, 0, 0, 0, 0, 0]), np.diag(SIGMA**2))
    belief = contact_filter.step(PERIOD, wild, np.eye(4))
    assert belief.rejected == 1 and "further away than 1e9 m" in belief.reason
    assert belief.valid
    assert contact_filter.rejections == {"not usable": 1}


def run(estimates, filter_settings):
    """Root mean square errors (6,) in standard deviations of the estimates, and mean NEES over 6."""
    contact_filter = ContactFilter(filter_settings)
    errors, nees = [], []
    for k, (truth, estimate) in enumerate(estimates):
        belief = contact_filter.step(k * PERIOD, PoseGaussian(estimate, np.diag(SIGMA**2)), np.eye(4))
        error = se3.log(truth @ se3.inverse(belief.mean))
        errors.append(error / SIGMA)
        nees.append(error @ np.linalg.solve(belief.cov, error) / 6)
    return np.sqrt(np.mean(np.square(errors), axis=0)), float(np.mean(nees))


def simulated(seed, count, draw):
    """Truth on a random walk by the filter's process noise, and estimates with errors by `draw(rng)`."""
    rng = np.random.default_rng(seed)
    truth, made = CONTACT, []
    for _ in range(count):
        truth = se3.exp(0.2 * SIGMA * rng.normal(size=6)) @ truth
        made.append((truth, se3.exp(SIGMA * draw(rng)) @ truth))
    return made


def student_t_errors(rng, dof=3.0):
    return rng.normal(size=6) * np.sqrt((dof - 2.0) / rng.chisquare(dof))


SLOW = FilterSettings(
    process_noise_translation=0.2 * 4e-4, process_noise_rotation=0.2 * 1.2e-2, gate_probability=1.0
)


def test_heavy_tails_cost_a_robust_filter_less():
    made = simulated(5, 1500, student_t_errors)
    plain, _ = run(made, SLOW)
    student, nees = run(made, SLOW.replaced(robust="student_t", student_t_dof=3.0))
    huber, _ = run(made, SLOW.replaced(robust="huber"))
    assert np.mean(student / plain) < 0.9
    assert np.mean(huber / plain) < 1.0
    assert 0.5 < nees < 1.5


def test_normal_errors_cost_a_robust_filter_little():
    made = simulated(6, 1500, lambda rng: rng.normal(size=6))
    plain, _ = run(made, SLOW)
    huber, _ = run(made, SLOW.replaced(robust="huber"))
    student, _ = run(made, SLOW.replaced(robust="student_t", student_t_dof=10.0))
    assert np.mean(huber / plain) < 1.01
    assert np.mean(student / plain) < 1.05


@pytest.mark.parametrize("robust", ["student_t", "huber"])
def test_an_unlikely_estimate_moves_a_robust_filter_less_and_the_belief_says_by_what_factor(robust):
    moved = {}
    for kind in ("none", robust):
        contact_filter = ContactFilter(FilterSettings(robust=kind, gate_probability=1.0))
        for k in range(4):
            contact_filter.step(k * PERIOD, PoseGaussian(CONTACT, np.diag(SIGMA**2)), np.eye(4))
        wild = PoseGaussian(se3.exp(6 * SIGMA) @ CONTACT, np.diag(SIGMA**2))
        belief = contact_filter.step(4 * PERIOD, wild, np.eye(4))
        assert belief.flags == BeliefFlag.MEASUREMENT_FUSED
        assert (belief.inflation > 1.5) == (kind != "none")
        moved[kind] = np.linalg.norm(se3.log(belief.mean @ se3.inverse(CONTACT)) / SIGMA)
    assert moved[robust] < 0.8 * moved["none"]
