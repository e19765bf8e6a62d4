"""What a camera publishes becomes the gray image that a network was trained on, or is refused."""

import cv2
import numpy as np
import pytest

from tactile_perception.estimating.encodings import ENCODINGS, decompressed, pixels_of
from tactile_perception.estimating.image import ImageError, read_image
from tactile_perception.estimating.preprocessing import Preprocessor

BT601 = np.array([0.299, 0.587, 0.114])  # of R, G and B
RGB = np.random.default_rng(3).integers(0, 256, (6, 8, 3), dtype=np.uint8)
ORDERS = {"rgb8": [0, 1, 2], "bgr8": [2, 1, 0], "rgba8": [0, 1, 2, 0], "bgra8": [2, 1, 0, 0]}


def gray(image: np.ndarray, encoding: str, padding: int = 0) -> np.ndarray:
    """The image (height, width, ...) as a message of that encoding, whose rows are padded, made gray."""
    rows = np.pad(image.reshape(image.shape[0], -1), [(0, 0), (0, padding)])
    return pixels_of(rows.ravel(), *image.shape[:2], rows.shape[1], encoding)


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("encoding", ORDERS)
def test_a_color_becomes_its_luma(encoding, padding):
    found = gray(RGB[:, :, ORDERS[encoding]], encoding, padding)
    assert found.dtype == np.uint8
    np.testing.assert_allclose(found, RGB @ BT601, atol=0.51)  # rounded


def test_a_color_of_a_message_is_as_gray_as_that_of_a_training_image(tmp_path):
    cv2.imwrite(str(tmp_path / "image.png"), RGB[:, :, ::-1])
    np.testing.assert_allclose(read_image(tmp_path / "image.png"), gray(RGB, "rgb8").astype(int), atol=1)


@pytest.mark.parametrize(
    "encoding, luma", [("yuv422_yuy2", 0), ("yuv422", 1), ("mono8", None), ("8UC1", None)]
)
def test_of_luma_with_or_without_color_the_luma_is_taken(encoding, luma):
    pixels = RGB[:, :, :2] if luma is not None else RGB[:, :, 0]
    expected = pixels if luma is None else pixels[:, :, luma]
    assert np.array_equal(gray(pixels, encoding, padding=3), expected)


@pytest.mark.parametrize("encoding", ["mono16", "bayer_rggb8", "32FC1", "8UC3", ""])
def test_an_encoding_of_which_no_model_says_how_it_becomes_gray_is_refused_with_those_that_can(encoding):
    with pytest.raises(ImageError, match=f"encoding is '{encoding}', must be 'mono8', or one of .*bgr8"):
        gray(RGB, encoding)


@pytest.mark.parametrize(
    "numbers, complaint",
    [
        ((0, 8, 24, "rgb8"), "image is empty"),
        ((6, 8, 23, "rgb8"), "step is 23 bytes, must be at least 3 times the width 8, 24"),
        ((6, 8, 7, "mono8"), "step is 7 bytes, must be at least the width 8"),
        ((5, 8, 24, "rgb8"), "data has 144 bytes, must have step \\* height = 120"),
    ],
)
def test_numbers_that_contradict_each_other_are_refused(numbers, complaint):
    with pytest.raises(ImageError, match=complaint):
        pixels_of(RGB.ravel(), *numbers)


@pytest.mark.parametrize("encoding", ORDERS)
def test_color_that_is_asked_for_is_kept(encoding):
    pixels = RGB[:, :, ORDERS[encoding]]
    rows = np.pad(pixels.reshape(6, -1), [(0, 0), (0, 5)])
    found = pixels_of(rows.ravel(), 6, 8, rows.shape[1], encoding, color=True)
    assert np.array_equal(found, RGB[:, :, ::-1])


@pytest.mark.parametrize("encoding, luma", [("yuv422_yuy2", 0), ("yuv422", 1)])
def test_color_of_luma_and_chroma_is_that_of_bt601(encoding, luma):
    """Studio range: black at 16, white at 235; U and V of two pixels each, about 128."""
    y, u, v = np.full((2, 4), 110), 100, 180
    cells = np.empty((2, 4, 2), np.uint8)
    cells[:, :, luma] = y
    cells[:, 0::2, 1 - luma], cells[:, 1::2, 1 - luma] = u, v
    found = pixels_of(cells.ravel(), 2, 4, 8, encoding, color=True)
    light = 1.164 * (110 - 16)
    blue, red = light + 2.018 * (u - 128), light + 1.596 * (v - 128)
    green = light - 0.813 * (v - 128) - 0.391 * (u - 128)
    np.testing.assert_allclose(found, np.broadcast_to([blue, green, red], (2, 4, 3)), atol=2)


def test_of_a_gray_message_no_color_is_made():
    assert pixels_of(RGB[:, :, 0].ravel(), 6, 8, 8, "mono8", color=True).shape == (6, 8)


def packed(image: np.ndarray, suffix: str) -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


@pytest.mark.parametrize(
    "form, color",
    [
        ("png", False),
        ("mono8; png", False),
        ("mono8; png compressed ", False),
        ("bgr8; png compressed bgr8", True),
        ("rgb8; png compressed bgr8", True),
    ],
)
def test_a_png_by_the_names_of_image_transport_is_what_was_compressed(form, color):
    if color:
        found = decompressed(packed(RGB[:, :, ::-1], ".png"), form).astype(int)
        np.testing.assert_allclose(found, gray(RGB, "rgb8"), atol=1)
    else:
        assert np.array_equal(decompressed(packed(RGB[:, :, 0], ".png"), form), RGB[:, :, 0])


@pytest.mark.parametrize("form", ["jpeg", "mono8; jpeg compressed ", "bgr8; jpeg compressed bgr8"])
def test_a_jpeg_is_gray_to_within_its_losses(form):
    smooth = cv2.resize(RGB, (160, 120), interpolation=cv2.INTER_CUBIC)
    image = smooth[:, :, ::-1] if "bgr8" in form else gray(smooth, "rgb8")
    difference = decompressed(packed(image, ".jpg"), form).astype(int) - gray(smooth, "rgb8")
    assert np.abs(difference).mean() < 2.0


@pytest.mark.parametrize(
    "data, form, complaint",
    [
        (
            packed(RGB, ".png"),
            "32FC1; compressedDepth png",
            "format is '32FC1; compressedDepth png', must be",
        ),
        (packed(RGB, ".png"), "mono16; png compressed ", "format is 'mono16; png compressed ', must be"),
        (packed(RGB, ".png"), "tiff", "format is 'tiff', must be 'jpeg' or 'png'"),
        (packed(RGB.astype(np.uint16), ".png"), "png", "PNG of 16 bits, must have 8"),
        (packed(RGB, ".png")[:-20], "png", "truncated"),
        (packed(RGB, ".jpg")[:-20], "jpeg", "without its end"),
        (b"", "jpeg", "not a readable image"),
        (b"nothing", "mono8; png", "not a readable image"),
    ],
)
def test_a_compressed_image_that_is_none_or_not_whole_is_refused(data, form, complaint):
    with pytest.raises(ImageError, match=complaint):
        decompressed(data, form)


def test_an_image_that_its_camera_has_cropped_as_the_model_says_is_prepared_as_the_whole_one():
    image = np.random.default_rng(5).integers(0, 256, (480, 640), dtype=np.uint8)
    prepare = Preprocessor()
    x0, y0, x1, y1 = prepare.settings.bbox
    assert np.array_equal(prepare(image[y0:y1, x0:x1].copy()), prepare(image))


def test_an_image_of_another_size_is_refused_with_both_that_would_be_right():
    with pytest.raises(ImageError, match="must be 640x480 pixels, is 440x445; or 445x440, cropped to"):
        Preprocessor()(np.zeros((445, 440), np.uint8))


def test_every_encoding_is_tested():
    assert set(ENCODINGS) == {*ORDERS, "mono8", "8UC1", "yuv422", "yuv422_yuy2"}


def test_a_compressed_image_keeps_its_colors_where_they_are_asked_for():
    smooth = cv2.GaussianBlur(np.kron(RGB, np.ones((8, 8, 1), np.uint8)), (0, 0), 4.0)
    assert np.array_equal(
        decompressed(packed(smooth, ".png"), "bgr8; png compressed bgr8", color=True), smooth
    )
    jpeg = decompressed(packed(smooth, ".jpg"), "bgr8; jpeg compressed bgr8", color=True)
    np.testing.assert_allclose(jpeg.astype(int), smooth, atol=12)
