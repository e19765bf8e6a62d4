"""Presence, then estimate: what perception makes of one image."""

import numpy as np
import pytest

from tactile_geometry import se3
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.image import ImageError
from tactile_perception.estimating.image_check import ImageCheck, ImageCheckSettings, ImageRefused
from tactile_perception.estimating.perceive import Perceiver
from tactile_perception.estimating.presence import ContactPresence, PresenceSettings
from tactile_scene.shapes.plane import Plane
from tactile_sim.tactip import TacTip

FREE = np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8)
TOUCHED = np.full((480, 640), 90, np.uint8)


#: These pictures are none of a sensor; what is refused of images is tested in test_image_check.py.
ANY = ImageCheckSettings(
    repeats=True, least_contrast=0.0, fewest_markers=0.0, most_markers=100.0, least_white=0.0,
    most_white=100.0, least_likeness=-1.0, least_continuity=-1.0, most_novelty=0.0,
)  # fmt: skip


def any_image() -> ImageCheck:
    return ImageCheck(ANY)


def presence() -> ContactPresence:
    return ContactPresence(PresenceSettings(reference_frames=2))


def test_an_estimate_is_made_in_contact_only(constant_model):
    estimator = Estimator(constant_model((0, 0, -1.0, 0, 0, 0)))
    perceive = Perceiver(estimator, presence(), any_image())
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
    perceive = Perceiver(Estimator(constant_model(mu=(np.nan,) * 6)), presence(), any_image())
    *_, percept = [perceive(image) for image in (FREE, FREE, TOUCHED)]
    assert percept.in_contact and percept.estimate is None
    assert "NaN" in percept.fault


def test_an_image_of_the_wrong_size_is_an_error(constant_model):
    with pytest.raises(ImageError, match="640x480"):
        Perceiver(Estimator(constant_model()), presence())(FREE[:100])


def test_images_in_which_the_network_sees_a_contact_are_no_reference(constant_model):
    perceive = Perceiver(Estimator(constant_model((0, 0, -3.1, 0, 0, 0))), presence(), any_image())
    percepts = [perceive(FREE) for _ in range(4)]
    assert [percept.in_contact for percept in percepts] == [None] * 4
    assert [percept.fault for percept in percepts[::2]] == ["", ""]
    assert (
        percepts[1].fault
        == percepts[3].fault
        == "the network sees a contact of 3.1 mm, must be at most 1.2 mm"
    )


@pytest.mark.parametrize(
    ("depth_mm", "refused"), [(None, False), (0.3, False), (1.6, True), (3.1, True), (6.0, True)]
)
def test_the_shipped_network_knows_a_contact_from_none(depth_mm, refused):
    sensor, perceive = TacTip(seed=5), Perceiver(Estimator(), presence())
    if depth_mm is not None:
        for height in (0.0205, 0.020 - depth_mm * 1e-3):
            sensor.advance(Plane(), se3.pose_from_euler([0, 0, height, np.pi, 0, 0]))
    percepts = [perceive(sensor.image()) for _ in range(2)]
    assert bool(percepts[1].fault) == refused


def test_a_covered_camera_gives_no_reference():
    perceive = Perceiver(Estimator(), presence(), any_image())
    assert [perceive(TOUCHED).fault for _ in range(2)][1].startswith("the network sees a contact")
    with pytest.raises(ImageRefused, match="without contrast: gray levels of 90 vary by 0"):
        Perceiver(Estimator(), presence())(TOUCHED)
