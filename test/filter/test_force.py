"""The force over time: against the textbook's Kalman filter, and what is refused."""

import numpy as np
import pytest

from tactile_filter.force import ForceFilter, ForceGaussian, ForceSettings

STEP_NS, NOISE = 20_000_000, 3.0
COV = np.array([[0.5, 0.1, 0.0], [0.1, 0.4, 0.05], [0.0, 0.05, 0.9]])


def walk(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A random walk and estimates of it."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(count, 3)) * NOISE * np.sqrt(STEP_NS * 1e-9)
    true = np.cumsum(steps, axis=0) + np.array([0.0, 0.0, 12.0])
    return true, true + rng.multivariate_normal(np.zeros(3), COV, count)


def test_a_random_walk_is_followed_as_by_information_filters():
    """Against the information form: precisions add, the prior's being that of the walk."""
    true, told = walk(400)
    force, nis, errors = ForceFilter(ForceSettings(noise=NOISE)), [], []
    mean, cov = told[0], COV
    for k, estimate in enumerate(told):
        assert force.step(k * STEP_NS, ForceGaussian(estimate, COV)) == ""
        if k:
            precision = np.linalg.inv(cov + NOISE**2 * STEP_NS * 1e-9 * np.eye(3))
            cov = np.linalg.inv(precision + np.linalg.inv(COV))
            mean = cov @ (precision @ mean + np.linalg.inv(COV) @ estimate)
            nis.append(force.nis)
        np.testing.assert_allclose(force.belief.mean, mean, rtol=1e-9)
        np.testing.assert_allclose(force.belief.cov, cov, rtol=1e-9)
        errors.append(force.belief.mean - true[k])
    assert np.mean(nis) == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / len(nis)))
    assert np.std(errors) < 0.8 * np.std(told - true)


def test_an_outlier_is_refused_and_after_several_the_belief_starts_anew():
    force = ForceFilter()
    force.step(0, ForceGaussian(np.zeros(3), COV))
    far = ForceGaussian(np.array([0.0, 0.0, 80.0]), COV)
    for k in range(1, 6):
        assert "NIS" in force.step(k * STEP_NS, far)
        assert np.array_equal(force.belief.mean, np.zeros(3))
    assert force.step(6 * STEP_NS, far) == "" and force.belief.mean[2] == 80.0
    assert force.rejected == 5


@pytest.mark.parametrize(
    "mean, cov", [([np.nan, 0, 0], COV), ([0, 0, 0], -COV), ([0, 0, 0], COV * np.nan), ([np.inf, 0, 0], COV)]
)
def test_what_is_no_gaussian_is_refused(mean, cov):
    force = ForceFilter()
    assert force.step(0, ForceGaussian(np.array(mean, float), cov)) == "it is not a Gaussian"
    assert force.belief is None and force.rejected == 1


def test_time_goes_forward_and_a_gap_or_a_clock_set_back_starts_anew():
    force, zero = ForceFilter(), ForceGaussian(np.zeros(3), COV)
    force.step(10**9, zero)
    assert force.step(10**9, zero) == "it is not later than the last"
    five = ForceGaussian(np.full(3, 5.0), COV)
    assert force.step(10**9 + 600_000_000, five) == "" and np.array_equal(force.belief.mean, five.mean)
    assert force.step(10**8 * 2, zero) == "" and np.array_equal(force.belief.mean, zero.mean)
    force.reset()
    assert force.belief is None
