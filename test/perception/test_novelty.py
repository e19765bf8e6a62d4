"""Novelty: the measure, other sensors and cameras, what becomes of an image that is foreign."""

import dataclasses
import json

import numpy as np
import pytest

from tactile_geometry import se3
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.image_check import FOREIGN, ImageRefused
from tactile_perception.estimating.novelty import FLOOR, Novelty, NoveltyDrift, NoveltyError
from tactile_perception.estimating.perceive import Perceiver
from tactile_perception.estimating.preprocessing import PreprocessingSettings, Preprocessor, as_input
from tactile_perception.estimating.presence import ContactPresence, PresenceSettings
from tactile_scene.shapes.plane import Plane
from tactile_scene.simulated_sensors import TacTipSettings
from tactile_sim.tactip import TacTip

PREPARE = Preprocessor(PreprocessingSettings())


def contacts(count: int, seed: int, **changes):
    """Camera images (count, 480, 640) of contacts within the paper's ranges."""
    settings = TacTipSettings()
    groups = {group: getattr(settings, group).replaced(**values) for group, values in changes.items()}
    tip = TacTip(dataclasses.replace(settings, **groups), seed=seed)
    random, images = np.random.default_rng(seed), []
    for _ in range(count):
        x, y, gamma = random.uniform(-1, 1, 3) * [2e-3, 2e-3, 0.08]
        pose = [x, y, 0.020 - random.uniform(0.5e-3, 6e-3), np.pi + random.uniform(-0.35, 0.35),
                random.uniform(-0.35, 0.35), gamma]  # fmt: skip
        tip.advance(Plane(), se3.pose_from_euler([0, 0, 0.0205, np.pi, 0, 0]))
        tip.advance(Plane(), se3.pose_from_euler(pose))
        images.append(tip.image())
    return np.array(images)


def prepared(images):
    return np.array([PREPARE.resized(PREPARE.processed(image)) for image in images])


@pytest.fixture(scope="module")
def own() -> Novelty:
    return Novelty.fit(prepared(contacts(150, seed=1)))


def of(novelty: Novelty, images):
    return np.array([novelty(as_input(image)) for image in prepared(images)])


def test_each_image_is_measured_against_all_others():
    images = np.random.default_rng(0).integers(0, 256, (40, 8, 8), dtype=np.uint8)
    images[:, 2, 3] = 7
    values, scores = images / 255.0, []
    for out in range(40):
        others = np.delete(values, out, axis=0)
        scores.append(np.mean(((values[out] - others.mean(0)) / (others.std(0) + FLOOR)) ** 2))
    novelty = Novelty.fit(images)
    assert novelty.limit == pytest.approx(1.5 * np.quantile(scores, 0.995), rel=1e-6)
    assert novelty.usual == pytest.approx(np.quantile(scores, 0.99) / novelty.limit, rel=1e-6)


def test_new_contacts_of_the_same_sensor_are_known(own):
    assert of(own, contacts(100, seed=2)).max() < 1.0


@pytest.mark.parametrize(
    "change",
    [
        {"camera": {"center_column": 345.0}},
        {"camera": {"distance": 0.045}},
        {"markers": {"azimuth_deg": 20.0, "pitch_deg": 8.0}},
    ],
)
def test_images_of_another_sensor_or_mount_are_foreign(own, change):
    """What is turned about its own middle is not seen here: nothing surrounds the simulated markers."""
    assert (of(own, contacts(20, seed=3, **change)) > 1.0).mean() >= 0.95


def test_shifted_images_and_those_of_no_sensor_are_foreign(own):
    images = contacts(5, seed=4)
    noise = np.random.default_rng(0).integers(0, 256, (5, 480, 640), dtype=np.uint8)
    for others in (noise, np.full_like(noise, 255), np.roll(images, 25, axis=2)):
        assert of(own, others).min() > 1.0


def test_deviations_grow_from_what_is_usual_on(own):
    assert own.growth(0.0) == own.growth(own.usual) == 1.0
    assert own.growth(1.0) == pytest.approx(2.0)
    assert own.growth(0.5 * (1.0 + own.usual)) == pytest.approx(1.5)


LEVELS = Preprocessor(PreprocessingSettings(threshold_method="none"))


def lit(count, seed, gain=1.0):
    """Prepared images (count, 128, 128) of contacts with their levels, by a camera of that gain."""
    images = contacts(count, seed, camera={"gain": gain})
    return np.array([LEVELS.resized(LEVELS.processed(image)) for image in images])


@pytest.fixture(scope="module")
def of_levels():
    return lit(150, seed=1)


@pytest.mark.parametrize("gain", [0.8, 1.25])
def test_another_light_is_foreign_where_levels_are_kept(of_levels, gain):
    def novelties(measure, images):
        return np.array([measure(as_input(image)) for image in images])

    told = Novelty.fit(of_levels, 0.0)
    assert novelties(told, lit(30, seed=2)).max() < 1.0 < novelties(told, lit(30, seed=2, gain=gain)).min()
    borne = Novelty.fit(of_levels, 2 * 0.15)
    assert borne.light == 0.3 and novelties(borne, lit(30, seed=2, gain=gain)).max() < 1.0
    without = Novelty.fit(of_levels)
    assert np.isinf(without.light) and novelties(without, lit(30, seed=2, gain=gain)).max() < 1.0


def test_99_of_100_training_images_have_the_usual_light(of_levels):
    novelty = Novelty.fit(of_levels, 0.0)
    level = as_input(of_levels).mean(axis=(1, 2, 3))
    off = np.abs(np.log(level / level.mean())) / novelty.light
    assert (off <= novelty.usual).mean() >= 0.98 and off.max() < 1.0


def test_images_that_are_all_alike_leave_room_for_one_without_contact(of_levels):
    assert Novelty.fit(of_levels[:3], 0.0).light >= 0.1


def test_the_light_is_in_the_model_file(of_levels):
    novelty = Novelty.fit(of_levels, 0.0)
    settings = LEVELS.settings
    again = Novelty.from_text(novelty.to_text(), settings)
    bright = as_input(lit(1, seed=3, gain=1.25)[0])
    assert again.light == novelty.light and again(bright) == novelty(bright) > 1.0
    values = json.loads(novelty.to_text())
    for wrong in (0.0, -1.0, float("nan"), "dim"):
        with pytest.raises(NoveltyError, match="novelty: "):
            Novelty.from_text(json.dumps(values | {"light": wrong}), settings)
    del values["light"]
    assert np.isinf(Novelty.from_text(json.dumps(values), settings).light), "of a model from before"


def test_it_stays_the_same_in_a_model_file(own):
    again = Novelty.from_text(own.to_text(), PREPARE.settings)
    images = contacts(3, seed=5)
    np.testing.assert_array_equal(of(again, images), of(own, images))
    assert (again.limit, again.usual) == (own.limit, own.usual)


@pytest.mark.parametrize(
    "change",
    [
        {"mean": "no image"},
        {"limit": "far"},
        {"limit": 0.0},
        {"usual": 1.5},
        {"spread": None},
        {"limit": float("nan")},
    ],
)
def test_what_is_none_is_refused(own, change):
    with pytest.raises(NoveltyError, match="novelty: "):
        Novelty.from_text(json.dumps(json.loads(own.to_text()) | change), PREPARE.settings)


def test_another_size_and_too_few_images_are_refused(own):
    with pytest.raises(NoveltyError, match=r"must be \(64, 64\)"):
        Novelty.from_text(own.to_text(), PREPARE.settings.replaced(size=64))
    with pytest.raises(NoveltyError, match="at least three images, has 2"):
        Novelty.fit(np.zeros((2, 64, 128), np.uint8))


def perceiver(novelty: Novelty | None) -> Perceiver:
    estimator = Estimator()
    estimator.metadata = dataclasses.replace(estimator.metadata, novelty=novelty)
    return Perceiver(estimator, ContactPresence(PresenceSettings(reference_frames=2)))


def pressed(*depths):
    """An image at each depth, m; of a negative one without contact."""
    tip, images = TacTip(seed=7), []
    for depth in depths:
        tip.advance(Plane(), se3.pose_from_euler([0, 0, 0.0202 - depth, np.pi, 0.05, 0]))
        images.append(tip.image())
    return images


def test_a_foreign_image_is_refused_in_contact_and_as_a_reference(own):
    images = pressed(-1e-3, -1e-3, 1e-3, 1e-3)
    perceive = perceiver(own)
    *_, known = [perceive(image) for image in images]
    assert known.in_contact and 0.0 < known.novelty < 1.0
    strict = dataclasses.replace(own, limit=0.01 * own.limit)
    perceive.estimator.metadata = dataclasses.replace(perceive.estimator.metadata, novelty=strict)
    with pytest.raises(ImageRefused, match=f"{FOREIGN}: by .* is the model this sensor's"):
        perceive(pressed(-1e-3, 1e-3)[-1])
    begins = perceiver(strict)
    assert FOREIGN in [begins(image) for image in images[:2]][-1].fault and not begins.presence.ready
    perceive.check.configure(perceive.check.settings.replaced(most_novelty=0.0))
    assert perceive(pressed(-1e-3, 1.1e-3)[-1]).estimate is not None


def test_the_covariance_of_an_unusual_image_grows(own):
    *free, touched = pressed(-1e-3, -1e-3, 1e-3)
    found = []
    for usual in (0.999, 0.01):
        perceive = perceiver(dataclasses.replace(own, usual=usual))
        *_, percept = [perceive(image) for image in (*free, touched)]
        found.append(percept)
    growth = dataclasses.replace(own, usual=0.01).growth(found[1].novelty)
    assert growth > 1.05
    np.testing.assert_allclose(found[1].estimate.cov, growth**2 * found[0].estimate.cov, rtol=1e-12)
    np.testing.assert_array_equal(found[1].estimate.mean, found[0].estimate.mean)


def test_without_a_measure_nothing_is_refused_and_nothing_grows():
    perceive = perceiver(None)
    *_, percept = [perceive(image) for image in pressed(-1e-3, -1e-3, 1e-3)]
    assert np.isnan(percept.novelty) and percept.estimate is not None


def test_a_mean_beyond_what_is_usual_of_single_images_is_told(own):
    drift = NoveltyDrift()
    drift.add(float("nan"))
    assert np.isnan(drift.mean)
    for k in range(600):
        assert drift.complaint(0.6) == ""
        drift.add(0.5 if k % 2 else 0.7)
    assert drift.mean == pytest.approx(0.6) and drift.complaint(0.61) == ""
    for _ in range(300):
        drift.add(0.9)
    assert "by 0.72 in the mean" in drift.complaint(0.6)
