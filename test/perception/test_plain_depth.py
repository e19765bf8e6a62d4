"""The depth by an image's brightness, and estimates that are refused for it."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.labels import depths, labels_from_euler
from tactile_perception.estimating.perceive import APART, DepthAgreement, Perceiver, Percept, depth_of
from tactile_perception.estimating.plain_depth import FIELDS, PlainDepth, PlainDepthError
from tactile_perception.estimating.preprocessing import as_input
from tactile_perception.estimating.presence import ContactPresence, PresenceSettings
from tactile_scene.shapes.plane import Plane
from tactile_sim.tactip import TacTip


def pressed(sensor, depth):
    """An image at a depth, m; of a negative one without contact."""
    for height in (0.0205, 0.020 - depth):
        sensor.advance(Plane(), se3.pose_from_euler([0, 0, height, np.pi, 0.1, 0]))
    return sensor.image()


def said(depth):
    """An estimate of X_sf that is so deep, m."""
    T_fs = se3.pose_from_euler([1e-3, -2e-3, depth, 0.2, -0.1, 0.05])
    return PoseGaussian(se3.inverse(T_fs), 1e-6 * np.eye(6))


def test_it_is_the_ridge_regression_whose_error_is_that_of_images_left_out():
    """Against one fit for each image left out, by least squares of the rows with the ridge below them."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (40, FIELDS, FIELDS), dtype=np.uint8)
    true = rng.normal(0.0, 1e-5, (FIELDS, FIELDS))
    known = 3e-3 + (images / 255.0 * true).sum(axis=(1, 2)) + rng.normal(0.0, 1e-4, 40)
    plain = PlainDepth.fit(images, known)
    rows, found = images.reshape(40, -1) / 255.0, []
    for ridge in 0.1 * 10.0 ** (0.5 * np.arange(7)):
        errors = []
        for out in range(40):
            kept = np.arange(40) != out
            # the means stay free: columns for the constant are not held down
            left = np.block(
                [
                    [rows[kept] - rows.mean(axis=0), np.ones((39, 1))],
                    [np.sqrt(ridge) * np.eye(FIELDS**2), np.zeros((FIELDS**2, 1))],
                ]
            )
            answer = np.linalg.lstsq(left, np.append(known[kept], np.zeros(FIELDS**2)), rcond=None)[0]
            errors.append(known[out] - (rows[out] - rows.mean(axis=0)) @ answer[:-1] - answer[-1])
        found.append(np.sqrt(np.mean(np.square(errors))))
    assert plain.rms == pytest.approx(min(found), rel=1e-6)
    assert plain(as_input(images[0])) == pytest.approx(known[0], abs=1e-3)


def test_it_stays_the_same_in_a_model_file():
    plain = Estimator().metadata.plain_depth
    again = PlainDepth.from_text(plain.to_text())
    image = np.random.default_rng(1).random((128, 128), dtype=np.float32)
    assert again(image) == pytest.approx(plain(image), abs=1e-9)
    assert (again.constant, again.rms) == pytest.approx((plain.constant, plain.rms))


@pytest.mark.parametrize(
    "change",
    [{"weights": [[1.0]]}, {"rms": "large"}, {"constant": None}, {"weights": [[float("nan")] * 16] * 16}],
)
def test_what_is_none_is_refused(change):
    values = {"weights": np.zeros((FIELDS, FIELDS)).tolist(), "constant": 3.0, "rms": 0.3, **change}
    with pytest.raises(PlainDepthError, match="plain depth: "):
        PlainDepth.from_text(json.dumps(values))


def test_one_image_is_too_few():
    with pytest.raises(PlainDepthError, match="at least two images, has 1"):
        PlainDepth.fit(np.zeros((1, 128, 128), np.uint8), [1e-3])


def test_depths_are_the_z_of_the_contact_pose():
    euler = np.array([[1.0, -2.0, 3.0, 10.0, -5.0, 2.0], [0.0, 0.0, 0.5, -20.0, 3.0, 0.0]])
    assert depths(labels_from_euler(euler)) == pytest.approx(1e-3 * euler[:, 2])
    assert depth_of(said(3e-3)) == pytest.approx(3e-3)


def test_the_shipped_models_is_right_to_a_millimetre_where_it_has_not_been():
    estimator, sensor = Estimator(), TacTip(seed=5)
    for depth in np.arange(1e-3, 6.1e-3, 1e-3):
        prepared = estimator.preprocessor(pressed(sensor, depth))
        assert estimator.metadata.plain_depth(prepared) == pytest.approx(depth, abs=1e-3)


@pytest.mark.parametrize(
    "off, refused", [(0.0, False), (1.4e-3, False), (-1.4e-3, False), (1.6e-3, True), (-1.6e-3, True)]
)
def test_an_estimate_is_refused_beyond_the_limit_and_told_with_both_depths(off, refused):
    agreement, percept = DepthAgreement(), Percept(True, 1.0, said(3e-3), plain_depth=3e-3 + off)
    *first, percept = [agreement(percept, 1.5e-3) for _ in range(APART)]
    assert all(one.estimate is not None for one in first)
    assert (percept.estimate is None) == refused
    told = f"3.0 mm deep, and the brightness of the image {3 + 1e3 * off:.1f} mm"
    assert percept.fault == refused * f"the network says that the contact is {told}"


def test_where_no_plain_depth_is_known_nothing_is_refused():
    agreement = DepthAgreement()
    assert all(agreement(Percept(True, 1.0, said(3e-3)), 1e-6).estimate is not None for _ in range(10))


def test_one_image_that_differs_among_others_is_not_refused():
    agreement = DepthAgreement()
    for depth in (3e-3, 5e-3, 3e-3, 5e-3, 3e-3):
        assert agreement(Percept(True, 1.0, said(3e-3), plain_depth=depth), 1.5e-3).estimate is not None


@pytest.mark.parametrize("depth, refused", [(2e-3, False), (5e-3, True)])
def test_of_images_an_estimate_that_stays_where_it_was_is_refused(monkeypatch, depth, refused):
    estimator, sensor = Estimator(), TacTip(seed=5)
    perceive = Perceiver(estimator, ContactPresence(PresenceSettings(reference_frames=2)))
    for _ in range(2):
        perceive(pressed(sensor, -1e-3))
    monkeypatch.setattr(estimator, "estimate_prepared", lambda prepared: said(2e-3))
    perceive.check = SimpleNamespace(
        settings=perceive.check.settings, still=False, exposure=lambda image: None,
        look=lambda *given: None, remember=lambda image: None, foreign=lambda novelty: "",
    )  # fmt: skip
    *_, percept = [perceive(pressed(sensor, depth)) for _ in range(APART)]
    assert percept.in_contact and (percept.estimate is None) == refused
    perceive.check.settings = perceive.check.settings.replaced(depth_difference=0.0)
    assert perceive(pressed(sensor, depth)).estimate is not None
