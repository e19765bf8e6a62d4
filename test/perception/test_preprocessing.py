"""Pre-processing: the paper's steps, both entries, and errors for images it cannot use."""

import cv2
import numpy as np
import pytest

from tactile_base.settings import SettingError
from tactile_perception.estimating.image import ImageError
from tactile_perception.estimating.preprocessing import PreprocessingSettings, Preprocessor, as_input
from tactile_perception.markers.detection import detect


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


def by_opencv(image: np.ndarray, settings: PreprocessingSettings) -> np.ndarray:
    """Crop, median, threshold and mask as OpenCV does them."""
    x0, y0, x1, y1 = settings.bbox
    crop = np.ascontiguousarray(image[y0:y1, x0:x1])
    if settings.median:
        crop = cv2.medianBlur(crop, settings.median)
    method = {"mean": cv2.ADAPTIVE_THRESH_MEAN_C, "gaussian": cv2.ADAPTIVE_THRESH_GAUSSIAN_C}
    binary = cv2.adaptiveThreshold(
        crop,
        255,
        method[settings.threshold_method],
        cv2.THRESH_BINARY,
        settings.threshold_block,
        settings.threshold_offset,
    )
    if settings.circle_mask_radius:
        mask = np.zeros(crop.shape, np.uint8)
        center = (crop.shape[1] // 2, crop.shape[0] // 2)
        cv2.circle(mask, center, settings.circle_mask_radius, 255, -1)
        binary &= mask
    return binary


def area_averages(image: np.ndarray, size: int) -> np.ndarray:
    """Means (size, size) over equal parts of an image, whose borders may split pixels, of exact sums."""
    sums = image.astype(np.int64)
    for side in image.shape:  # down the columns, then, of what that gives transposed, along the rows
        start, pixel = side * np.arange(size)[:, np.newaxis], size * np.arange(side)
        covered = np.minimum(start + side, pixel + size) - np.maximum(start, pixel)
        sums = (np.maximum(covered, 0) @ sums).T
    return sums / image.size


def random_images(shape: tuple[int, int], seed: int = 0) -> list[np.ndarray]:
    """Noise, noise with many equal values, and something smooth."""
    rng = np.random.default_rng(seed)
    noise = rng.integers(0, 256, shape, dtype=np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3.0)
    return [noise, noise // 64 * 64, cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX)]


def test_a_camera_image_becomes_the_networks_input():
    prepared = Preprocessor()(marker_image())
    assert prepared.shape == (1, 1, 128, 128)
    assert prepared.dtype == np.float32
    assert prepared.min() == 0.0 and prepared.max() == 1.0


def test_markers_come_out_white_and_the_ground_black_under_uneven_light():
    binary = Preprocessor().processed(marker_image())
    x0, y0, _, _ = PreprocessingSettings().bbox
    assert set(np.unique(binary)) == {0, 255}
    for x in (216, 326, 436):
        assert binary[236 - y0, x - x0] == 255
        assert binary[236 + 11 - y0, x + 11 - x0] == 0


def test_nothing_outside_the_circle_mask_is_white():
    binary = Preprocessor().processed(np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8))
    rows, columns = np.nonzero(binary)
    assert np.hypot(rows - 220, columns - 222).max() <= 230.5


def test_mask_can_be_switched_off():
    settings = PreprocessingSettings(circle_mask_radius=0)
    assert Preprocessor(settings).processed(np.full((480, 640), 9, np.uint8))[0, 0] == 255


def test_single_dust_pixels_disappear():
    clean = marker_image(noise=0.0)
    dusty = clean.copy()
    dusty[100:400:17, 150:500:23] = 255
    difference = Preprocessor().processed(dusty) != Preprocessor().processed(clean)
    assert difference.mean() < 0.002


def test_brightness_of_the_camera_does_not_matter():
    image = marker_image()
    np.testing.assert_array_equal(Preprocessor()(image + np.uint8(25)), Preprocessor()(image))


def test_processed_crop_and_camera_image_give_the_same_input():
    preprocessor = Preprocessor()
    image = marker_image()
    np.testing.assert_array_equal(
        preprocessor.from_processed(preprocessor.processed(image)), preprocessor(image)
    )


def test_redrawn_markers_have_one_size_and_what_is_no_marker_is_gone():
    image = marker_image()
    image[30:33, 300:420] = 255  # a reflection
    plain, redrawing = (Preprocessor(PreprocessingSettings(size=440, redraw_radius=r)) for r in (0.0, 8.0))
    before, after = (detect(p.resized(plain.processed(image))) for p in (plain, redrawing))
    assert len(after) == len(before) > 50
    assert np.median(before.areas) < 130.0
    assert after.areas == pytest.approx(np.pi * 8.0**2, rel=0.15)
    np.testing.assert_array_equal(redrawing(image), redrawing.from_processed(plain.processed(image)))
    row = 31 - plain.settings.bbox[1]
    assert plain.resized(plain.processed(image))[row].any()
    assert not redrawing.resized(plain.processed(image))[row].any()


def test_an_image_without_markers_is_redrawn_black():
    settings = PreprocessingSettings(redraw_radius=6.0)
    assert not Preprocessor(settings).resized(np.zeros(settings.crop_shape, np.uint8)).any()


def test_results_of_earlier_images_stay_as_they_were():
    preprocessor = Preprocessor()
    first = preprocessor.processed(marker_image())
    kept = first.copy()
    preprocessor.processed(marker_image(shift=7.0, seed=1))
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


def test_of_a_processed_crop_of_another_size_the_whole_is_taken():
    crop = random_images((420, 420))[1]
    expected = area_averages(crop, 128)
    np.testing.assert_allclose(Preprocessor().resized(crop), expected, atol=0.501)


@pytest.mark.parametrize("shape", [(440, 445, 3), (0, 445), (440,)])
def test_a_processed_crop_that_is_no_gray_image_is_refused(shape):
    with pytest.raises(ImageError, match="processed image: must be a gray image"):
        Preprocessor().from_processed(np.zeros(shape, np.uint8))


def test_settings_say_in_what_they_differ():
    settings = PreprocessingSettings()
    assert settings.differences(settings) == ""
    other = settings.replaced(median=3, circle_mask_radius=0)
    assert other.differences(settings) == "median = 3, not 5; circle_mask_radius = 0, not 230"


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
    np.testing.assert_allclose(batch[:, 0, 0, 0], [0.0, 0.2, 1.0], atol=1e-5)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"median": 0},
        {"median": 3},
        {"threshold_block": 3},
        {"threshold_block": 255},
        {"threshold_block": 301},
        {"threshold_offset": -7.0},
        {"threshold_offset": 4.3},
        {"threshold_method": "gaussian"},
        {"circle_mask_radius": 0},
        {"bbox": (3, 1, 40, 478), "threshold_block": 101},
    ],
    ids=str,
)
def test_pixels_are_those_of_opencv(changes):
    settings = PreprocessingSettings(**changes)
    preprocessor = Preprocessor(settings)
    for image in [marker_image(), *random_images(settings.raw_shape)]:
        np.testing.assert_array_equal(preprocessor.processed(image), by_opencv(image, settings))


def check_resized(image: np.ndarray) -> None:
    """The rounded average, either way where OpenCV's sums of floats are half way between levels."""
    ours, averages = Preprocessor().resized(image), area_averages(image, 128)
    np.testing.assert_allclose(ours, averages, atol=0.501)


def test_network_input_is_the_average_of_the_thresholded_crop():
    preprocessor = Preprocessor()
    for seed in range(5):
        image = marker_image(shift=2.3 * seed, seed=seed)
        crop = by_opencv(image, preprocessor.settings)
        np.testing.assert_array_equal(preprocessor(image), preprocessor.from_processed(crop))
        check_resized(crop)
    for crop in random_images(preprocessor.settings.crop_shape):
        check_resized(crop)


@pytest.mark.parametrize("size", [16, 64, 96, 110, 256, 440])
def test_other_sizes_of_the_network_input_are_averages_too(size):
    preprocessor = Preprocessor(PreprocessingSettings(size=size))
    for crop in [preprocessor.processed(marker_image()), *random_images(preprocessor.settings.crop_shape)]:
        np.testing.assert_allclose(preprocessor.resized(crop), area_averages(crop, size), atol=0.501)


def test_images_may_lie_in_memory_in_any_way():
    image = marker_image()
    expected = Preprocessor()(image)
    wide = np.zeros((500, 700), np.uint8)
    wide[7:487, 13:653] = image
    np.testing.assert_array_equal(Preprocessor()(wide[7:487, 13:653]), expected)
    np.testing.assert_array_equal(Preprocessor()(np.asfortranarray(image)), expected)
    every_second = np.repeat(np.repeat(image, 2, axis=0), 2, axis=1)[::2, ::2]
    np.testing.assert_array_equal(Preprocessor()(every_second), expected)
    turned = np.ascontiguousarray(image[::-1, ::-1])
    np.testing.assert_array_equal(Preprocessor()(turned[::-1, ::-1]), expected)
    upside_down = np.ascontiguousarray(image[::-1])
    np.testing.assert_array_equal(Preprocessor()(upside_down[::-1]), expected)
