"""Pre-processing: the paper's steps, both entries, and errors for images it cannot use."""

import cv2
import numpy as np
import pytest

from tactile_filter.settings import SettingError
from tactile_perception.preprocessing import ImageError, PreprocessingSettings, Preprocessor, as_input


def marker_image(shift: float = 0.0, noise: float = 3.0, seed: int = 0) -> np.ndarray:
    """A camera-like image: bright dots on a dim, uneven background, with noise."""
    rng = np.random.default_rng(seed)
    image = np.full((480, 640), 40.0) + np.linspace(0.0, 40.0, 640)
    for x in np.arange(150.0, 510.0, 22.0):
        for y in np.arange(60.0, 420.0, 22.0):
            if np.hypot(x - 327, y - 240) < 200:
                cv2.circle(
                    image, (int(16 * (x + shift)), int(16 * y)), 16 * 6, 200.0, -1, cv2.LINE_AA, shift=4
                )
    return np.clip(image + rng.normal(0.0, noise, image.shape), 0, 230).astype(np.uint8)


def test_a_camera_image_becomes_the_networks_input():
    prepared = Preprocessor()(marker_image())
    assert prepared.shape == (1, 1, 128, 128)
    assert prepared.dtype == np.float32
    assert prepared.min() == 0.0 and prepared.max() == 1.0


def test_markers_come_out_white_and_the_ground_black_under_uneven_light():
    binary = Preprocessor().binary(marker_image())
    x0, y0, _, _ = PreprocessingSettings().bbox
    assert set(np.unique(binary)) == {0, 255}
    for x in (216, 326, 436):
        assert binary[236 - y0, x - x0] == 255
        assert binary[236 + 11 - y0, x + 11 - x0] == 0


def test_nothing_outside_the_circle_mask_is_white():
    binary = Preprocessor().binary(np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8))
    rows, columns = np.nonzero(binary)
    assert np.hypot(rows - 220, columns - 222).max() <= 230.5


def test_mask_can_be_switched_off():
    settings = PreprocessingSettings(circle_mask_radius=0)
    assert Preprocessor(settings).binary(np.full((480, 640), 9, np.uint8))[0, 0] == 255


def test_single_dust_pixels_disappear():
    clean = marker_image(noise=0.0)
    dusty = clean.copy()
    dusty[100:400:17, 150:500:23] = 255
    difference = Preprocessor().binary(dusty) != Preprocessor().binary(clean)
    assert difference.mean() < 0.002


def test_brightness_of_the_camera_does_not_matter():
    image = marker_image()
    np.testing.assert_array_equal(Preprocessor()(image + np.uint8(25)), Preprocessor()(image))


def test_processed_crop_and_camera_image_give_the_same_input():
    preprocessor = Preprocessor()
    image = marker_image()
    np.testing.assert_array_equal(
        preprocessor.from_processed(preprocessor.binary(image)), preprocessor(image)
    )


def test_results_of_earlier_images_stay_as_they_were():
    preprocessor = Preprocessor()
    first = preprocessor.binary(marker_image())
    kept = first.copy()
    preprocessor.binary(marker_image(shift=7.0, seed=1))
    np.testing.assert_array_equal(first, kept)


@pytest.mark.parametrize(
    "image, message",
    [
        (np.zeros((240, 320), np.uint8), "must be 640x480 pixels, is 320x240"),
        (np.zeros((480, 640, 3), np.uint8), "must be a gray image"),
        (np.zeros((480, 640), np.float32), "must be 8-bit .* is float32"),
        (np.zeros((480, 640), np.uint16), "is uint16"),
        ([[0]], "must be a NumPy array, is list"),
    ],
)
def test_unusable_camera_images_are_refused_with_what_would_be_right(image, message):
    with pytest.raises(ImageError, match=message):
        Preprocessor()(image)


def test_a_processed_crop_of_another_size_is_refused():
    with pytest.raises(ImageError, match="must be 445x440 pixels, is 128x128"):
        Preprocessor().from_processed(np.zeros((128, 128), np.uint8))


def test_a_channel_axis_of_one_is_accepted():
    image = marker_image()
    np.testing.assert_array_equal(Preprocessor()(image[:, :, None]), Preprocessor()(image))


@pytest.mark.parametrize(
    "values, message",
    [
        ({"bbox": (105, 20, 700, 460)}, "bbox"),
        ({"bbox": (105, 20, 105, 460)}, "bbox"),
        ({"threshold_block": 60}, "must be odd"),
        ({"median": 4}, "must be one of 0, 3, 5"),
    ],
)
def test_settings_that_cannot_work_are_refused(values, message):
    with pytest.raises(SettingError, match=message):
        PreprocessingSettings(**values)


def test_a_stack_of_images_becomes_a_batch():
    stack = np.stack([np.full((128, 128), value, np.uint8) for value in (0, 51, 255)])
    batch = as_input(stack)
    assert batch.shape == (3, 1, 128, 128)
    np.testing.assert_allclose(batch[:, 0, 0, 0], [0.0, 0.2, 1.0], atol=1e-7)
