"""Calibration of predicted standard deviations on data whose true deviations are known."""

import numpy as np
import pytest
from scipy.optimize import minimize

from tactile_perception.evaluation.calibration import (
    Calibration,
    CalibrationError,
    CalibrationSettings,
    fit_calibration,
)

SIGMA = np.array([0.5, 0.5, 0.1, 0.01, 0.01, 0.02])


def generator(count: int, factor, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Labels, means and claimed deviations; the true ones are factor(mean, sigma) times those."""
    rng = np.random.default_rng(seed)
    mean = rng.normal(size=(count, 6)) * [2, 2, 1.5, 0.2, 0.2, 0.05] + [0, 0, -3, 0, 0, 0]
    sigma = SIGMA * np.exp(rng.normal(0.0, 0.5, (count, 6)))
    return mean + rng.normal(size=(count, 6)) * sigma * factor(mean, sigma), mean, sigma


def nees(labels, mean, cov) -> float:
    error = labels - mean
    return float(np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error))) / 6.0


def test_without_arguments_nothing_changes():
    cov = np.diag(SIGMA**2)
    assert Calibration().is_identity
    np.testing.assert_array_equal(Calibration().covariance(np.zeros(6), cov), cov)
    np.testing.assert_array_equal(Calibration().factors(np.zeros(6), SIGMA), np.ones(6))


def test_one_image_gets_the_factors_of_many():
    labels, mean, sigma = generator(800, lambda mean, sigma: 1.5 + 0.5 * (sigma > SIGMA))
    settings = CalibrationSettings(depth_knots=3)
    calibration = fit_calibration(labels, mean, sigma, settings)
    beyond = sigma * np.geomspace(1e-3, 1e3, len(sigma))[:, None]
    expected = calibration.factors(mean, beyond)
    for row in range(0, len(mean), 40):
        np.testing.assert_allclose(calibration.factors(mean[row], beyond[row]), expected[row], rtol=1e-13)


def test_an_honest_network_is_left_as_it_is():
    data = generator(20_000, lambda mean, sigma: 1.0)
    fitted = fit_calibration(*data)
    np.testing.assert_allclose(fitted.factors(data[1], data[2]), 1.0, atol=0.08)


def test_an_overconfident_network_gets_its_factor_back_on_other_data():
    true = np.array([2.0, 0.5, 3.0, 1.0, 1.5, 10.0])
    fitted = fit_calibration(*generator(6000, lambda mean, sigma: true), CalibrationSettings(sigma_knots=1))
    np.testing.assert_allclose(fitted.factors(np.zeros(6), SIGMA), true, rtol=0.03)
    labels, mean, sigma = generator(6000, lambda mean, sigma: true, seed=1)
    cov = fitted.covariance(mean, np.apply_along_axis(np.diag, 1, sigma**2))
    assert nees(labels, mean, cov) == pytest.approx(1.0, abs=0.05)


def test_a_factor_that_depends_on_the_deviation_is_found():
    def factor(mean, sigma):
        return np.clip((sigma / SIGMA) ** 0.7, 0.5, 2.0)

    fitted = fit_calibration(*generator(8000, factor))
    for scale in (0.6, 1.0, 1.6):
        expected = factor(None, scale * SIGMA)
        np.testing.assert_allclose(fitted.factors(np.zeros(6), scale * SIGMA), expected, rtol=0.12)


def test_a_factor_that_depends_on_the_depth_is_found():
    def factor(mean, sigma):
        return np.exp(-0.4 * (np.clip(mean[:, 2:3], -5.0, -1.0) + 3.0))

    fitted = fit_calibration(*generator(8000, factor), CalibrationSettings(sigma_knots=1, depth_knots=5))
    means = np.zeros((3, 6))
    means[:, 2] = [-4.5, -3.0, -1.5]
    np.testing.assert_allclose(
        fitted.factors(means, np.tile(SIGMA, (3, 1))), factor(means, SIGMA) * np.ones(6), rtol=0.12
    )


def test_each_component_has_nees_one_on_the_fitted_data():
    """The likelihood is largest where it is; stiffness does not hold the mean of the knots."""
    labels, mean, sigma = generator(500, lambda mean, sigma: 1.0 + np.abs(mean), seed=3)
    fitted = fit_calibration(labels, mean, sigma, CalibrationSettings(depth_knots=4))
    z = (labels - mean) / (sigma * fitted.factors(mean, sigma))
    np.testing.assert_allclose((z**2).mean(axis=0), 1.0, atol=1e-6)


def test_the_fit_is_the_maximum_of_the_penalized_likelihood():
    labels, mean, sigma = generator(400, lambda mean, sigma: 2.0 * sigma / SIGMA, seed=4)
    fitted = fit_calibration(labels, mean, sigma, CalibrationSettings(sigma_knots=3, stiffness=7.0))
    knots, squared = fitted.sigma_knots[0], ((labels - mean) / sigma)[:, 0] ** 2

    def cost(values):
        h = np.interp(np.log(sigma[:, 0]), knots, values)
        return np.sum(h + 0.5 * squared * np.exp(-2 * h)) + 3.5 * np.sum(np.diff(values) ** 2)

    best = minimize(cost, np.zeros(3), tol=1e-12)
    np.testing.assert_allclose(fitted.sigma_values[0], best.x, atol=1e-4)


def test_a_margin_widens_what_the_data_ask_for():
    data = generator(400, lambda mean, sigma: 2.0)
    margin = (1.5, 1.0, 1.0, 1.0, 1.0, 1.2)
    fitted, wide = fit_calibration(*data), fit_calibration(*data, CalibrationSettings(margin=margin))
    ratio = wide.factors(data[1], data[2]) / fitted.factors(data[1], data[2])
    np.testing.assert_allclose(ratio, np.tile(margin, (400, 1)))


def test_a_floor_is_added_in_quadrature():
    data = generator(400, lambda mean, sigma: 2.0)
    floor = (0.0, 0.3, 0.1, 0.0, 0.0, 0.01)
    fitted, raised = fit_calibration(*data), fit_calibration(*data, CalibrationSettings(floor=floor))
    expected = np.hypot(data[2] * fitted.factors(data[1], data[2]), floor)
    np.testing.assert_allclose(data[2] * raised.factors(data[1], data[2]), expected)
    np.testing.assert_allclose(data[2][7] * raised.factors(data[1][7], data[2][7]), expected[7])
    assert not Calibration(floor=floor).is_identity


def test_a_component_that_always_states_the_same_has_one_factor():
    labels, mean, sigma = generator(300, lambda mean, sigma: 2.0)
    sigma[:, 3] = 0.01
    fitted = fit_calibration(labels, mean, sigma)
    assert [len(knots) for knots in fitted.sigma_knots] == [5, 5, 5, 1, 5, 5]
    assert not fitted.is_identity
    expected = np.sqrt((((labels - mean) / sigma)[:, 3] ** 2).mean())
    np.testing.assert_allclose(fitted.factors(mean, sigma)[:, 3], expected)


def test_correlated_errors_give_a_joint_nees_of_one():
    labels, mean, sigma = generator(4000, lambda mean, sigma: 1.0, seed=5)
    mixing = np.eye(6)
    mixing[0, 4] = 0.8
    labels = mean + ((labels - mean) / sigma) @ mixing.T * sigma
    fitted = fit_calibration(labels, mean, sigma, CalibrationSettings(correlation=True))
    cov = fitted.covariance(mean, np.apply_along_axis(np.diag, 1, sigma**2))
    assert fitted.correlation[0][4] == pytest.approx(0.8 / np.hypot(1.0, 0.8), abs=0.03)
    assert nees(labels, mean, cov) == pytest.approx(1.0, abs=0.02)


def test_a_full_covariance_keeps_its_correlation():
    _, mean, sigma = generator(300, lambda mean, sigma: 1.0)
    fitted = fit_calibration(mean + 3.0 * sigma, mean, sigma, CalibrationSettings(sigma_knots=1))
    mixing = np.linalg.cholesky(np.full((6, 6), 0.3) + 0.7 * np.eye(6)) * SIGMA[:, None]
    cov = fitted.covariance(mean[0], mixing @ mixing.T)
    np.testing.assert_allclose(cov, 9.0 * mixing @ mixing.T, rtol=1e-6)


def test_the_standard_error_shrinks_with_the_samples():
    few = fit_calibration(*generator(400, lambda mean, sigma: 1.0))
    many = fit_calibration(*generator(6400, lambda mean, sigma: 1.0))
    assert few.nees_error == pytest.approx(np.sqrt(2.0 / 6.0 / 400), rel=0.2)
    assert many.nees_error == pytest.approx(few.nees_error / 4.0, rel=0.2)
    assert (few.samples, many.samples) == (400, 6400)


def test_it_comes_back_from_its_text_unchanged():
    settings = CalibrationSettings(depth_knots=3, correlation=True, floor=(0.1,) * 6)
    fitted = fit_calibration(*generator(300, lambda mean, sigma: 2.0), settings)
    assert Calibration.from_json(fitted.to_json()) == fitted


@pytest.mark.parametrize(
    "text, message",
    [
        ("{", "is not JSON"),
        ('{"format": "other/1"}', "format is 'other/1', must be 'tactile_servoing.calibration/1'"),
        ('{"format": "tactile_servoing.calibration/1", "hue": 1}', "unexpected keyword argument 'hue'"),
        ('{"format": "tactile_servoing.calibration/1", "depth_knots": [1.0, 0.0]}', "increasing knots"),
        ('{"format": "tactile_servoing.calibration/1", "depth_knots": [NaN]}', "depth_knots: nan is not"),
        ('{"format": "tactile_servoing.calibration/1", "correlation": [[1.0]]}', "symmetric"),
        ('{"format": "tactile_servoing.calibration/1", "floor": [1.0]}', "floor: must be 6 numbers"),
    ],
)
def test_an_unusable_text_is_an_error_that_says_why(text, message):
    with pytest.raises(CalibrationError, match=message):
        Calibration.from_json(text)


def test_too_few_samples_are_refused():
    with pytest.raises(CalibrationError, match="at least 100 held-out samples, got 60"):
        fit_calibration(*generator(60, lambda mean, sigma: 1.0))


@pytest.mark.parametrize(
    "spoil, message",
    [
        (lambda y, m, s: (y[:-1], m, s), "mean: must have the shape"),
        (lambda y, m, s: (y, m, -s), "must be positive"),
        (lambda y, m, s: (np.where(y > 5, np.nan, y), m, s), "labels: .* not finite"),
    ],
)
def test_data_that_do_not_fit_together_are_refused(spoil, message):
    with pytest.raises(CalibrationError, match=message):
        fit_calibration(*spoil(*generator(300, lambda mean, sigma: 1.0)))
