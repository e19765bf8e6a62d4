"""Images differ as the variation's settings say, and not at all without."""

import cv2
import numpy as np
import pytest

from tactile_perception.markers.detection import detect
from tactile_scene.simulated_sensors import TacTipSettings
from tactile_sim.collection import press_then_shear
from tactile_sim.tactip import TacTip
from tactile_sim.variation import VariationSettings, other_sensors, varied

DEEP, SHALLOW = 4e-3, 0.0
NOTHING = VariationSettings(
    shift=0.0, scale=0.0, rotation_deg=0.0, field=0.0, marker_growth=0.0, gain=(1.0, 1.0), reflections=0
)


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    sensor = TacTip(seed=2)
    press_then_shear(sensor, np.array([1e-3, 0.0, 2e-3, 0.1, 0.0, 0.0]))
    return sensor.image()


def shown(image, settings, depth, rng) -> np.ndarray:
    return varied(image, np.zeros((0, 2)), settings, depth, rng)[0]


def moved(image: np.ndarray, settings: VariationSettings, depth: float, seed: int) -> np.ndarray:
    """Displacement (331, 2) of the markers by a variation."""
    before = detect(image).centers
    after = detect(shown(image, settings, depth, np.random.default_rng(seed))).centers
    nearest = np.linalg.norm(before[:, None] - after[None], axis=2).argmin(axis=1)
    return after[nearest] - before


def test_without_any_difference_the_image_stays(image):
    np.testing.assert_array_equal(shown(image, NOTHING, DEEP, np.random.default_rng(0)), image)


def test_the_same_random_numbers_give_the_same_image(image):
    a, b, c = (shown(image.copy(), VariationSettings(), DEEP, np.random.default_rng(s)) for s in (1, 1, 2))
    assert np.array_equal(a, b) and not np.array_equal(a, c)


def test_a_shift_moves_all_markers_alike(image):
    shifts = np.array([moved(image, NOTHING.replaced(shift=2.0), DEEP, seed) for seed in range(30)])
    assert shifts.std(axis=1).max() < 0.15
    assert shifts.mean(axis=1).std() == pytest.approx(2.0, rel=0.3)


def test_a_turn_and_a_scale_are_about_the_middle(image):
    middle = np.array(image.shape[::-1]) / 2
    away = detect(image).centers - middle
    turned = moved(image, NOTHING.replaced(rotation_deg=1.0), DEEP, 3)
    assert np.abs(np.sum(turned * away, axis=1)).max() < 0.6 * np.linalg.norm(away, axis=1).max()
    across = np.linalg.norm(turned, axis=1) / np.linalg.norm(away, axis=1)
    assert np.std(across[np.linalg.norm(away, axis=1) > 60]) < 0.1 * across.mean() + 1e-3
    scaled = moved(image, NOTHING.replaced(scale=0.02), DEEP, 3)
    factor = np.sum(scaled * away) / np.sum(away * away)
    np.testing.assert_allclose(scaled, factor * away, atol=0.4)


def test_the_field_is_smooth_has_its_size_and_needs_contact(image):
    settings = NOTHING.replaced(field=1.5)
    fields = np.array([moved(image, settings, DEEP, seed) for seed in range(20)])
    assert fields.std() == pytest.approx(1.5, rel=0.15)
    centers = detect(image).centers
    near = np.argsort(np.linalg.norm(centers[:, None] - centers[None], axis=2), axis=1)[:, 1]
    assert np.std(fields - fields[:, near]) < 0.4 * 1.5
    assert np.abs(moved(image, settings, SHALLOW, 1)).max() < 0.1


@pytest.mark.parametrize(("gain", "brighter"), [((1.2, 1.2), True), ((0.8, 0.8), False)])
def test_gain_brightens_or_darkens(image, gain, brighter):
    mean = shown(image, NOTHING.replaced(gain=gain), DEEP, np.random.default_rng(0)).mean()
    assert (mean > image.mean()) == brighter


def test_where_the_markers_are_is_told(image):
    settings = NOTHING.replaced(shift=2.0, scale=0.01, rotation_deg=1.0, field=3.0)
    before = detect(image).centers
    for seed in range(5):
        after, told = varied(image, before, settings, DEEP, np.random.default_rng(seed))
        blobs = detect(after).centers
        off = np.linalg.norm(told[:, None] - blobs[None], axis=2).min(axis=1)
        assert np.median(off) < 0.15 and np.quantile(off, 0.95) < 0.6
        assert np.linalg.norm(told - before, axis=1).mean() > 1.0


def test_markers_grow_and_shrink(image):
    areas = [
        np.median(detect(shown(image, NOTHING.replaced(marker_growth=1.0), DEEP, rng)).areas)
        for rng in map(np.random.default_rng, range(12))
    ]
    usual = np.median(detect(image).areas)
    assert min(areas) < 0.95 * usual and max(areas) > 1.05 * usual


def test_reflections_lie_outside_the_markers_circle(image):
    settings = NOTHING.replaced(reflections=40)
    changed = cv2.absdiff(shown(image.copy(), settings, DEEP, np.random.default_rng(5)), image) > 20
    rows, columns = np.nonzero(changed)
    distance = np.hypot(columns - image.shape[1] / 2, rows - image.shape[0] / 2)
    assert len(distance) > 500 and distance.min() > settings.reflection_radius[0] - 20


def test_other_sensors_differ_in_gel_pins_and_lens_and_a_seed_tells_which():
    own, *others = other_sensors(TacTipSettings(), 4, seed=3)
    assert own == TacTipSettings() and len({own, *others}) == 4
    assert (own, *others) == other_sensors(TacTipSettings(), 4, seed=3)
    assert others[0] != other_sensors(TacTipSettings(), 4, seed=4)[1]
    for other in others:
        assert other.skin.stiffness_ratio != own.skin.stiffness_ratio
        assert other.camera.rotation_deg == own.camera.rotation_deg
        assert other.markers.pitch_deg == pytest.approx(own.markers.pitch_deg, rel=0.2)


def test_of_many_other_sensors_none_has_what_no_sensor_can_have():
    assert max(sensor.skin.poisson_ratio for sensor in other_sensors(TacTipSettings(), 300, seed=5)) == 0.49


def test_images_of_other_sensors_show_other_pins():
    own, other = (TacTip(settings, seed=2) for settings in other_sensors(TacTipSettings(), 2, seed=3))
    at_rest = [detect(sensor.image()).centers for sensor in (own, other)]
    spread = [np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean() for centers in at_rest]
    assert abs(spread[1] / spread[0] - 1.0) > 0.01
