"""Presence, then estimate: what perception makes of one image."""

import numpy as np
import pytest

from tactile_perception.estimating.image import ImageError
from tactile_perception.estimating.perceive import Perceiver
from tactile_perception.estimating.presence import ContactPresence, PresenceSettings
from tactile_perception.estimator import Estimator

FREE = np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8)
TOUCHED = np.full((480, 640), 90, np.uint8)


def presence() -> ContactPresence:
    return ContactPresence(PresenceSettings(reference_frames=2))


def test_an_estimate_is_made_in_contact_only(constant_model):
    estimator = Estimator(constant_model((0, 0, -3.0, 0, 0, 0)))
    perceive = Perceiver(estimator, presence())
    percepts = [perceive(image) for image in (FREE, FREE, FREE, TOUCHED, FREE)]
    assert [percept.in_contact for percept in percepts] == [None, None, False, True, False]
    assert [percept.estimate is not None for percept in percepts] == [False, False, False, True, False]
    assert np.isnan(percepts[0].score) and percepts[3].score > percepts[2].score
    expected = estimator.estimate(TOUCHED)
    np.testing.assert_array_equal(percepts[3].estimate.mean, expected.mean)
    np.testing.assert_array_equal(percepts[3].estimate.cov, expected.cov)


def test_without_a_presence_every_image_is_estimated(constant_model):
    perceive = Perceiver(Estimator(constant_model()))
    for percept in (perceive(FREE), perceive(np.zeros((440, 445), np.uint8), processed=True)):
        assert percept.in_contact is None and percept.estimate is not None


def test_an_answer_that_is_no_gaussian_leaves_the_presence_and_says_why(constant_model):
    perceive = Perceiver(Estimator(constant_model(mu=(np.nan,) * 6)), presence())
    *_, percept = [perceive(image) for image in (FREE, FREE, TOUCHED)]
    assert percept.in_contact and percept.estimate is None
    assert "NaN" in percept.fault


def test_an_image_of_the_wrong_size_is_an_error(constant_model):
    with pytest.raises(ImageError, match="640x480"):
        Perceiver(Estimator(constant_model()), presence())(FREE[:100])
