"""Carrying a belief on to the time of the command."""

import numpy as np
import pytest
from contact_case import CONTACT

from tactile_filter.prediction import ContactPredictor, PredictionSettings
from tactile_geometry import se3

PERIOD = 16_000_000
START = se3.exp([0.4, 0.1, 0.2, 0.0, 3.0, 0.0])
TWIST = np.array([0.02, 0.0, 0.001, 0.0, 0.3, 0.05])  # of the sensor in {s}


def sensor(t):
    return START @ se3.exp(t * TWIST)


def fed(settings, contact_at, count=120, noise=0.0):
    rng = np.random.default_rng(0)
    predictor = ContactPredictor(settings)
    for k in range(count):
        t = k * PERIOD / 1e9
        seen = se3.exp(noise * np.repeat((1e-4, 2e-3), 3) * rng.normal(size=6)) @ contact_at(t)
        predictor.update(k * PERIOD, seen, sensor(t))
    return predictor, (count - 1) * PERIOD


def still(t):
    """The contact with a surface that stands still."""
    return se3.inverse(sensor(t)) @ START @ CONTACT


def taken_along(t):
    """The contact of a sensor that follows its surface well."""
    return CONTACT


@pytest.mark.parametrize("motion_time", [0.0, 0.3])
def test_over_a_still_surface_the_contact_moves_as_the_sensor_does(motion_time):
    predictor, last = fed(PredictionSettings(motion_time=motion_time), still)
    later = last + 50_000_000
    np.testing.assert_allclose(predictor.ahead(later, sensor(later / 1e9)), still(later / 1e9), atol=1e-12)
    np.testing.assert_allclose(predictor.twist, 0.0, atol=1e-11)


def test_a_feature_that_moves_along_a_screw_is_carried_on_along_it():
    predictor, last = fed(PredictionSettings(motion_time=0.3), taken_along)
    later = last + 50_000_000
    error = se3.log(predictor.ahead(later, sensor(later / 1e9)) @ se3.inverse(CONTACT))
    assert np.abs(error[:3]).max() < 1e-5
    assert np.abs(error[3:]).max() < 1e-4
    expected = se3.adjoint(se3.inverse(CONTACT)) @ TWIST
    np.testing.assert_allclose(predictor.twist, expected, atol=0.01 * np.abs(expected).max())


def test_taken_as_still_the_moving_feature_lags_by_the_motion_in_that_time():
    predictor, last = fed(PredictionSettings(motion_time=0.0), taken_along)
    error = se3.log(predictor.ahead(last + 50_000_000, sensor(last / 1e9 + 0.05)) @ se3.inverse(CONTACT))
    np.testing.assert_allclose(error, -0.05 * TWIST, atol=2e-4)


def test_noise_of_the_beliefs_hardly_adds_to_the_prediction():
    predictor, last = fed(PredictionSettings(motion_time=0.3), taken_along, count=400, noise=1.0)
    later = last + 20_000_000
    error = se3.log(predictor.ahead(later, sensor(later / 1e9)) @ se3.inverse(CONTACT))
    assert np.abs(error[:3]).max() < 5e-4
    assert np.abs(error[3:]).max() < 1e-2


def test_what_is_not_known_or_too_old_is_not_predicted():
    predictor = ContactPredictor(PredictionSettings(longest=0.1))
    assert predictor.ahead(0, START) is None
    predictor.update(PERIOD, CONTACT, START)
    assert predictor.ahead(0, START) is None
    np.testing.assert_allclose(predictor.ahead(PERIOD, START), CONTACT, atol=1e-13)
    assert predictor.ahead(PERIOD + 100_000_001, START) is None
    predictor.reset()
    assert predictor.ahead(PERIOD, START) is None


def test_beliefs_that_repeat_change_nothing_and_after_a_gap_motion_is_estimated_anew():
    predictor, last = fed(PredictionSettings(motion_time=0.3), taken_along)
    twist = predictor.twist
    predictor.update(last, CONTACT, START)
    np.testing.assert_array_equal(predictor.twist, twist)
    predictor.update(last + 400_000_000, CONTACT, sensor(3.0))
    np.testing.assert_array_equal(predictor.twist, 0.0)
