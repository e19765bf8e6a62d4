"""A scene that stands still is told from one that moves by hundredths of a pixel, whatever the noise."""

import numpy as np
import pytest
from scipy import ndimage

from tactile_perception.estimating.stillness import FRAMES, Stillness

IMAGES = 64


@pytest.fixture(scope="module")
def scene():
    """White markers on dark ground, with the blur of a lens."""
    rows, columns = np.mgrid[0:240, 0:320]
    markers = (np.sin(rows / 5.0) * np.sin(columns / 5.0) > 0.6) * 180.0
    return ndimage.gaussian_filter(markers, 1.5) + 30.0


def camera(scene, seed, sigma, shift=lambda k: 0.0):
    """Images of a scene that is shifted by so many columns in the k-th, with new noise in each."""
    random = np.random.default_rng(seed)
    slope = np.gradient(scene, axis=1)
    for k in range(10**6):
        noisy = scene - shift(k) * slope + random.normal(0.0, sigma, scene.shape)
        yield np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def after(images, count, stillness=None):
    """What has been concluded of so many of them."""
    stillness = stillness or Stillness(IMAGES)
    for _, image in zip(range(count), images, strict=False):
        stillness.add(image)
    return stillness


@pytest.mark.parametrize("sigma", [0.4, 2.0, 8.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_scene_that_stands_still_is_known_after_so_many_images_and_not_before(scene, seed, sigma):
    images = camera(scene, seed, sigma)
    stillness = after(images, IMAGES - 1)
    assert not stillness.still and np.isnan(stillness.change)
    after(images, 1, stillness)
    assert stillness.still and abs(stillness.change) < 0.012


@pytest.mark.parametrize("seed", range(3))
def test_one_that_trembles_by_a_few_hundredths_of_a_pixel_is_none(scene, seed):
    stillness = Stillness(IMAGES)
    images = camera(scene, seed, 2.0, lambda k: 0.05 * np.sin(0.15 * k))
    said = [after(images, FRAMES, stillness).still for _ in range(5 * IMAGES // FRAMES)]
    assert not any(said)


def test_the_change_is_the_variance_of_the_means_beyond_that_of_noise(scene):
    """Against the numbers as NumPy has them, of all images at once."""
    images = camera(scene, 1, 2.0, lambda k: 0.05 * np.sin(0.1 * k))
    shown = [next(images) for _ in range(3 * IMAGES)]
    stillness = after(iter(shown), len(shown))
    latest = np.array(shown[-IMAGES:], float).reshape(-1, FRAMES, *scene.shape)[:, :, ::2, ::2]
    noise = np.square(np.diff(latest, axis=1)).mean() / 2.0
    expected = latest.mean(axis=1).var(axis=0, ddof=1).mean() / (noise / FRAMES) - 1.0
    assert stillness.change == pytest.approx(expected, rel=1e-5) and expected > 0.1


def test_a_scene_that_stops_is_still_a_window_later_and_moves_at_once(scene):
    still_from, moves_from = 2 * IMAGES, 4 * IMAGES
    images = camera(scene, 2, 2.0, lambda k: 0.0 if still_from <= k < moves_from else 0.3 * np.sin(0.2 * k))
    stillness = Stillness(IMAGES)
    said = [after(images, 1, stillness).still for _ in range(moves_from + FRAMES)]
    assert said.index(True) + 1 in range(still_from + IMAGES, still_from + IMAGES + FRAMES + 1)
    assert not said[-1]


def test_images_of_another_size_begin_anew_and_those_without_noise_are_still(scene):
    stillness = after(camera(scene, 1, 2.0), IMAGES)
    after(camera(scene[:200], 1, 2.0), IMAGES - 1, stillness)
    assert not stillness.still
    drawn = np.rint(scene).astype(np.uint8)
    assert after(iter([drawn] * IMAGES), IMAGES).still
    other = [drawn] * (IMAGES // 2) + [drawn + 1] * (IMAGES // 2)
    assert not after(iter(other), IMAGES).still
