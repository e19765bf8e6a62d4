"""What makes a frame no exposure: it repeats itself, shows nothing, or is a damaged JPEG."""

import cv2
import numpy as np
import pytest

from tactile_base.exposures import REMEMBERED, DamagedJpeg, Exposures, objection, pixels_of_jpeg
from tactile_doubles.lying_camera import jpeg, torn
from tactile_sim.tactip import TacTip


@pytest.fixture(scope="module")
def image():
    return TacTip(seed=3).image()


@pytest.mark.parametrize("quality", [60, 90, 98])
def test_a_whole_jpeg_has_the_pixels_of_another_decoder(image, quality):
    """OpenCV, of which the pixels in data sets and older recordings are."""
    data = jpeg(image, quality)
    assert np.array_equal(
        pixels_of_jpeg(data), cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    )
    plain = cv2.imencode(".jpg", image)[1]
    assert np.array_equal(pixels_of_jpeg(plain), cv2.imdecode(plain, cv2.IMREAD_GRAYSCALE))


@pytest.mark.parametrize("lost", [512, 1024, 3060])
def test_a_jpeg_of_which_a_packet_is_lost_is_refused_a_hundred_times_of_a_hundred(image, lost):
    data, random = jpeg(image), np.random.default_rng(lost)
    for _ in range(100):
        with pytest.raises(DamagedJpeg, match="bytes"):
            pixels_of_jpeg(torn(data, random, lost))


def test_bytes_with_which_some_cameras_pad_their_frames_are_no_damage(image):
    data = jpeg(image)
    padded = data[:-2] + bytes(range(1, 9)) + data[-2:]
    assert np.array_equal(pixels_of_jpeg(padded), pixels_of_jpeg(data))


def test_a_jpeg_that_claims_to_be_huge_is_refused_before_there_is_memory_for_it(image):
    data = jpeg(image)
    at = data.index(b"\xff\xc0") + 5  # height and width of the frame header: ITU-T T.81, B.2.2
    with pytest.raises(DamagedJpeg, match="65000x65000 pixels"):
        pixels_of_jpeg(data[:at] + 2 * (65000).to_bytes(2, "big") + data[at + 4 :])


@pytest.mark.parametrize(
    "data", [b"", b"abc", b"\xff\xd8\xff\xd9", b"\xff\xd8\xff\xe0" + bytes(40) + b"\xff\xd9"]
)
def test_what_is_no_jpeg_is_refused(data):
    with pytest.raises(DamagedJpeg):
        pixels_of_jpeg(data)


def test_a_frame_repeats_the_last_one_only_if_every_bit_is_the_same_also_in_the_same_memory(image):
    seen, frame = Exposures(), image.copy()
    assert not seen.repeats(frame) and "the one before it" in seen.repeats(frame)
    frame[0, 0] ^= 1
    assert not seen.repeats(frame) and seen.repeats(frame.copy())
    assert not seen.repeats(frame[:100])
    seen.forget()
    assert not seen.repeats(frame[:100])


def test_a_recording_that_begins_anew_is_known_by_its_first_frame_as_far_back_as_frames_are_remembered():
    random = np.random.default_rng(1)
    frames = random.integers(0, 256, (REMEMBERED + 2, 40, 60), dtype=np.uint8)
    seen = Exposures()
    assert not any(seen.repeats(frame) for frame in frames[:60])
    assert "one of the last 60" in seen.repeats(frames[0]) and "one of the last 60" in seen.repeats(frames[1])
    assert not any(seen.repeats(frame) for frame in frames[60:])
    assert not seen.repeats(frames[0]), "it was forgotten"
    assert seen.repeats(frames[3])


def test_an_image_whose_gray_levels_hardly_vary_shows_nothing(image):
    assert objection(image, 4.0) == ""
    assert "gray levels of 90 vary by 0.0, must by 4" in objection(np.full((480, 640), 90, np.uint8), 4.0)
    assert objection(np.full((480, 640), 90, np.uint8), 0.0) == ""
