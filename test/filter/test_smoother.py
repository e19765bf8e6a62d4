"""Smoothing against the joint distribution of all poses, and what it gains over filtering."""

import numpy as np
import pytest
from contact_case import CONTACT, COV, SIGMA
from scipy.optimize import least_squares
from scipy.stats import chi2

from tactile_filter.bayes_filter import BeliefFlag, ContactFilter, FilterSettings
from tactile_filter.smoother import smooth
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

PERIOD = 8_000_000
NOISE = np.repeat((1e-4, 2e-3), 3)
SETTINGS = FilterSettings(
    process_noise_translation=1e-4, process_noise_rotation=2e-3, gate_probability=1.0, fusion_mode="exact"
)


def perturbed(mean, sigma, rng):
    return se3.exp(sigma * rng.normal(size=6)) @ mean


def simulated(count, seed, scale=1.0):
    """Sensor poses, true contact poses and estimates; `scale` on all deviations."""
    rng = np.random.default_rng(seed)
    sensor, truth = se3.exp([0.3, 0.2, 0.1, 0.0, 3.0, 0.5]), CONTACT
    poses, truths, estimates = [], [], []
    for k in range(count):
        moved = sensor @ se3.exp(np.array([2e-4, 0, 1e-5, 2e-3, 1e-3, 2e-3]))
        if k:
            truth = perturbed(se3.inverse(moved) @ sensor @ truth, scale * NOISE, rng)
        sensor = se3.orthonormalized(moved)
        poses.append(sensor)
        truths.append(truth)
        estimates.append(PoseGaussian(perturbed(truth, scale * SIGMA, rng), scale**2 * COV))
    return poses, truths, estimates


def filtered(poses, estimates, settings):
    contact_filter = ContactFilter(settings)
    return [
        contact_filter.step(k * PERIOD, e, T) for k, (e, T) in enumerate(zip(estimates, poses, strict=True))
    ]


def joint_map(poses, estimates, noise, sigma):
    """Most likely poses and the marginal covariances, by least squares over all of them at once."""
    count = len(poses)

    def residuals(x):
        X = [se3.exp(xi) @ e.mean for xi, e in zip(x.reshape(count, 6), estimates, strict=True)]
        rows = [xi / sigma for xi in x.reshape(count, 6)]
        for k in range(1, count):
            T_k = se3.inverse(poses[k]) @ poses[k - 1]
            rows.append(se3.log(X[k] @ se3.inverse(T_k @ X[k - 1])) / noise)
        return np.concatenate(rows)

    found = least_squares(
        residuals, np.zeros(6 * count), jac="3-point", x_scale=np.tile(sigma, count), xtol=1e-15, ftol=1e-15
    )
    cov = np.linalg.inv(found.jac.T @ found.jac)
    X = []
    for k, e in enumerate(estimates):
        xi, at = found.x[6 * k : 6 * k + 6], slice(6 * k, 6 * k + 6)
        J = se3.left_jacobian(xi)
        X.append((se3.exp(xi) @ e.mean, J @ cov[at, at] @ J.T))
    return X


def test_smoothed_beliefs_are_the_marginals_of_the_joint_distribution():
    scale = 0.02  # small errors: the linear theory is exact to second order in them
    poses, _, estimates = simulated(7, 1, scale)
    settings = SETTINGS.replaced(process_noise_translation=scale * 1e-4, process_noise_rotation=scale * 2e-3)
    found = smooth(filtered(poses, estimates, settings), poses, settings)
    expected = joint_map(poses, estimates, scale * NOISE, scale * SIGMA)
    for belief, (mean, cov) in zip(found, expected, strict=True):
        deviation = np.sqrt(np.diag(cov))
        error = se3.log(belief.mean @ se3.inverse(mean))
        np.testing.assert_allclose(error / deviation, 0.0, atol=2e-3)
        np.testing.assert_allclose(
            belief.cov / np.outer(deviation, deviation), cov / np.outer(deviation, deviation), atol=2e-3
        )


def test_the_last_belief_is_the_filters():
    poses, _, estimates = simulated(5, 2)
    beliefs = filtered(poses, estimates, SETTINGS)
    assert smooth(beliefs, poses, SETTINGS)[-1] is beliefs[-1]


def test_smoothing_errs_less_than_filtering_and_its_covariance_says_by_how_much():
    errors, nees = {"filter": [], "smoother": []}, {"filter": [], "smoother": []}
    for seed in range(40):
        poses, truths, estimates = simulated(31, 100 + seed)
        beliefs = filtered(poses, estimates, SETTINGS)
        for name, answer in (("filter", beliefs), ("smoother", smooth(beliefs, poses, SETTINGS))):
            # one belief from the middle of each run: independent between runs
            error = se3.log(truths[15] @ se3.inverse(answer[15].mean))
            errors[name].append(error / SIGMA)
            nees[name].append(error @ np.linalg.solve(answer[15].cov, error))
    rms = {name: np.sqrt(np.mean(np.square(e))) for name, e in errors.items()}
    assert rms["smoother"] < 0.85 * rms["filter"]
    low, high = chi2.ppf((0.0005, 0.9995), 6 * 40)
    assert low < np.sum(nees["filter"]) < high
    assert low < np.sum(nees["smoother"]) < high


def test_covariances_never_grow_and_stay_positive_definite():
    poses, _, estimates = simulated(60, 3)
    beliefs = filtered(poses, estimates, SETTINGS)
    for before, after in zip(beliefs, smooth(beliefs, poses, SETTINGS), strict=True):
        np.testing.assert_array_equal(after.cov, after.cov.T)
        scale = np.sqrt(np.diag(before.cov))
        assert np.linalg.eigvalsh(after.cov / np.outer(scale, scale))[0] > 0.0
        # they belong to tangent spaces a little apart
        assert np.linalg.eigvalsh((before.cov - after.cov) / np.outer(scale, scale))[0] > -1e-2


def test_steps_without_a_measurement_gain_the_most():
    poses, _, estimates = simulated(40, 4)
    for k in (20, 21, 22):
        estimates[k] = PoseGaussian(estimates[k].mean, np.full((6, 6), np.nan))
    beliefs = filtered(poses, estimates, SETTINGS)
    found = smooth(beliefs, poses, SETTINGS)
    gained = [
        1.0 - (np.diag(a.cov) / SIGMA**2).sum() / (np.diag(b.cov) / SIGMA**2).sum()
        for a, b in zip(found, beliefs, strict=True)
    ]
    assert np.argmax(gained[10:30]) == 12
    assert found[21].flags == BeliefFlag.PREDICTED_ONLY


def test_nothing_is_carried_back_over_a_restart_of_the_filter():
    poses, _, estimates = simulated(12, 5)
    contact_filter = ContactFilter(SETTINGS)
    beliefs = []
    for k in range(12):
        if k == 6:
            contact_filter.reset("no contact")
        beliefs.append(contact_filter.step(k * PERIOD, estimates[k], poses[k]))
    found = smooth(beliefs, poses, SETTINGS)
    np.testing.assert_array_equal(found[5].cov, beliefs[5].cov)
    assert not np.array_equal(found[4].cov, beliefs[4].cov)
    assert not np.array_equal(found[6].cov, beliefs[6].cov)


def test_beliefs_that_repeat_or_are_none_are_passed_over():
    poses, _, estimates = simulated(8, 6)
    contact_filter = ContactFilter(SETTINGS)
    nothing = contact_filter.step(0, PoseGaussian(np.full((4, 4), np.nan), COV), poses[0])
    beliefs = [nothing] + [contact_filter.step((k + 1) * PERIOD, estimates[k], poses[k]) for k in range(8)]
    expected = smooth(beliefs, [poses[0], *poses], SETTINGS)
    assert not expected[0].valid
    again = contact_filter.step(4 * PERIOD, estimates[3], poses[3])
    lost = [np.full((4, 4), np.nan)]
    found = smooth([*beliefs, again], [poses[0], *poses, *lost], SETTINGS)
    np.testing.assert_array_equal(found[3].mean, expected[3].mean)
    np.testing.assert_array_equal(found[-1].mean, expected[-1].mean)


def test_settings_of_noise_by_time_are_those_of_the_filter():
    poses, _, estimates = simulated(6, 7)
    timed = SETTINGS.replaced(process_noise_interval=PERIOD / 1e9)
    found = smooth(filtered(poses, estimates, timed), poses, timed)
    expected = smooth(filtered(poses, estimates, SETTINGS), poses, SETTINGS)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a.mean, b.mean, atol=1e-13)


def test_as_many_poses_as_beliefs_are_needed():
    with pytest.raises(ValueError, match="0 beliefs and 1 poses"):
        smooth([], [np.eye(4)])
