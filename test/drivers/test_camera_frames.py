"""What a driver makes of the frames of a video device: gray exposures with their time, or refusals."""

import itertools

import numpy as np
import pytest
from other_package.double_camera import FRAMES, jpeg, picture

from tactile_base.stamps import SECOND_NS
from tactile_drivers.camera_frames import (
    ARRIVAL,
    MONOTONIC,
    REALTIME,
    Arrival,
    FrameIntake,
    FrameRefused,
    frame_image,
)

START = Arrival(5_000 * SECOND_NS, 1_800_000_000 * SECOND_NS)  # steady clock, ROS time
RATE, MS = 100.0, 1_000_000
PICTURES = (jpeg(picture(number)) for number in itertools.count(100))


def later(ms: float) -> Arrival:
    return Arrival(START.steady_ns + round(ms * MS), START.now_ns + round(ms * MS))


def intake(**changes) -> FrameIntake:
    return FrameIntake(640, 480, "MJPG", RATE, least_contrast=4.0, **changes)


def take(stream: FrameIntake, ms: float, raw=None, age_ms: float = 3.0):
    """A frame exposed at this time after the start, by a device that stamps by CLOCK_MONOTONIC."""
    raw = next(PICTURES) if raw is None else raw
    return stream.take(raw, START.steady_ns / MS + ms, later(ms + age_ms))


@pytest.mark.parametrize(
    "source, clock_ms, expected_ms",
    [
        (MONOTONIC, START.steady_ns / MS, 0.0),
        (REALTIME, START.now_ns / MS, 0.0),
        (ARRIVAL, 0.0, 3.0),  # a device without stamps
    ],
)
def test_a_frame_has_the_kernels_time_in_ros_time_where_there_is_one_and_else_that_of_its_arrival(
    source, clock_ms, expected_ms
):
    stream = intake()
    frame = stream.take(FRAMES[0], clock_ms, later(3.0))
    assert stream.clock.source == source
    assert frame.stamp_ns == pytest.approx(START.now_ns + expected_ms * MS, abs=1000)  # a double of ms


def test_a_device_with_a_clock_of_its_own_is_stamped_at_arrival_once_that_is_sure():
    stream = intake()
    taken = [stream.take(next(PICTURES), 77.0 + 10.0 * k, later(10.0 * k)) for k in range(12)]
    assert [frame is not None for frame in taken] == [False] * 9 + [True] * 3
    assert stream.clock.source == ARRIVAL and taken[-1].stamp_ns == later(110.0).now_ns


def test_a_first_frame_that_was_held_up_does_not_hide_the_clock_of_the_device():
    stream = intake()
    assert take(stream, 0.0, age_ms=1500.0) is None
    assert take(stream, 1500.0) is not None and stream.clock.source == MONOTONIC


def test_stamps_follow_a_clock_that_is_set():
    stream = intake()
    first = take(stream, 0.0, FRAMES[0])
    arrival = later(13.0)
    arrival = Arrival(arrival.steady_ns, arrival.now_ns + SECOND_NS)
    second = stream.take(FRAMES[1], START.steady_ns / MS + 10.0, arrival)
    assert second.stamp_ns - first.stamp_ns == pytest.approx(SECOND_NS + 10 * MS, abs=1000)


def test_the_delay_from_exposure_to_stamp_is_taken_off():
    assert take(intake(delay=0.004), 0.0).stamp_ns == pytest.approx(START.now_ns - 4 * MS, abs=1000)


def test_exposures_that_are_missing_are_counted_by_the_stamps():
    stream = intake()
    frames = [take(stream, ms) for ms in (0, 10, 20, 50, 60, 100)]
    assert [frame.lost for frame in frames] == [0, 0, 0, 2, 2, 5]


def test_a_frame_that_arrives_late_is_not_taken_for_one_after_a_gap():
    stream = intake()
    ages = [3.0, 3.0, 25.0, 15.0, 5.0]
    frames = [take(stream, 10.0 * k, age_ms=age) for k, age in enumerate(ages)]
    assert frames[-1].lost == 0
    rate, spread, largest = stream.intervals()
    assert rate == pytest.approx(RATE, rel=1e-4) and spread < 2e-6 and largest < 2e-6


def test_jitter_of_the_stamps_is_told_as_it_is():
    strays = np.random.default_rng(2).normal(0.0, 0.5, 200)
    stream = intake()
    for k, stray in enumerate(strays):
        take(stream, 10.0 * k + stray)
    steps = np.diff(10.0 * np.arange(200) + strays)
    rate, spread, largest = stream.intervals()
    assert rate == pytest.approx(1e3 / steps.mean(), rel=1e-4)
    assert spread == pytest.approx(steps.std() * 1e-3, rel=1e-2)
    assert largest == pytest.approx(np.abs(steps - steps.mean()).max() * 1e-3, rel=1e-2)


REFUSALS = {
    "torn": (FRAMES[1][:, :2000], "torn: a JPEG of 2000 bytes without its end"),
    "no JPEG": (np.full((1, 500), 217, np.uint8), "torn: "),
    "small": (jpeg(picture(1, 320, 240)), "of another size: 320x240 pixels, must be 640x480"),
    "black": (jpeg(picture(1) // 100), "without contrast: gray levels of 0 vary by 0"),
    "gray": (
        jpeg(np.full((480, 640), 128, np.uint8)),
        "without contrast: gray levels of 128 vary by 0.0",
    ),
    "frozen": (FRAMES[0], "repeated: it equals the one before it bit for bit"),
}


@pytest.mark.parametrize("raw, complaint", REFUSALS.values(), ids=REFUSALS)
def test_a_frame_that_is_no_exposure_is_refused_and_counted_and_the_next_one_taken(raw, complaint):
    stream = intake()
    assert take(stream, 0.0, FRAMES[0]) is not None
    assert take(stream, 10.0, raw) is None
    assert stream.last_refusal.startswith(complaint)
    assert stream.refused == {complaint.split(":")[0]: 1}
    frame = take(stream, 20.0, FRAMES[2])
    assert frame is not None and frame.lost == 1


@pytest.mark.parametrize(
    "stamp_ms, complaint",
    [
        (-2000.0, "its stamp is 2.013 s before its arrival"),
        (500.0, "its stamp is -0.487 s before its arrival"),
        (0.0, "its stamp is 0.000 ms before that of the last frame"),
    ],
)
def test_a_stamp_that_cannot_be_is_refused_and_counted(stamp_ms, complaint):
    stream = intake()
    take(stream, 0.0, FRAMES[0])
    assert stream.take(FRAMES[1], START.steady_ns / MS + stamp_ms, later(13.0)) is None
    assert complaint in stream.last_refusal and stream.refused == {"stamped wrongly": 1}
    assert take(stream, 20.0, FRAMES[2]) is not None


def test_repeated_and_dark_frames_are_taken_where_the_settings_say_so():
    stream = FrameIntake(640, 480, "MJPG", RATE, repeats=True)
    dark = jpeg(np.zeros((480, 640), np.uint8))
    assert take(stream, 0.0, dark) is not None and take(stream, 10.0, dark) is not None


COLOR = np.random.default_rng(4).integers(0, 256, (4, 6, 2), dtype=np.uint8)


@pytest.mark.parametrize(
    "form, raw, expected",
    [
        ("YUYV", COLOR, COLOR[:, :, 0]),
        ("UYVY", COLOR, COLOR[:, :, 1]),
        ("GREY", COLOR[:, :, 0], COLOR[:, :, 0]),
        ("NV12", np.vstack([COLOR[:, :, 0], COLOR[:2, :, 1]]), COLOR[:, :, 0]),
    ],
)
def test_of_each_format_the_luma_is_the_image(form, raw, expected):
    assert np.array_equal(frame_image(raw, form, 6, 4), expected)
    with pytest.raises(FrameRefused, match=f"is no {form} of 6x5 pixels"):
        frame_image(raw, form, 6, 5)


@pytest.mark.parametrize("form, luma", [("YUYV", 0), ("UYVY", 1)])
def test_a_color_is_that_of_bt601(form, luma):
    """Studio range: black at 16, white at 235; U and V of two pixels each, about 128."""
    raw = np.empty((4, 6, 2), np.uint8)
    raw[:, :, luma] = 90
    raw[:, 0::2, 1 - luma], raw[:, 1::2, 1 - luma] = 150, 100
    light = 1.164 * (90 - 16)
    expected = [light + 2.018 * 22, light - 0.391 * 22 + 0.813 * 28, light - 1.596 * 28]
    np.testing.assert_allclose(
        frame_image(raw, form, 6, 4, color=True), np.broadcast_to(expected, (4, 6, 3)), atol=2
    )


def test_a_gray_device_and_a_jpeg_give_colors_where_they_are_asked_for():
    gray = frame_image(COLOR[:, :, 0], "GREY", 6, 4, color=True)
    assert np.array_equal(gray, np.repeat(COLOR[:, :, :1], 3, axis=2))
    assert frame_image(FRAMES[0], "MJPG", 640, 480, color=True).shape == (480, 640, 3)
    nv12 = np.vstack([np.full((4, 6), 90, np.uint8), np.full((2, 6), 128, np.uint8)])
    np.testing.assert_allclose(frame_image(nv12, "NV12", 6, 4, color=True), 1.164 * (90 - 16), atol=2)


def test_a_jpeg_padded_with_zeros_is_whole():
    padded = np.pad(FRAMES[0], [(0, 0), (0, 3000)])
    assert np.array_equal(frame_image(padded, "MJPG", 640, 480), frame_image(FRAMES[0], "MJPG", 640, 480))


def test_a_jpeg_without_huffman_tables_as_cameras_send_it_is_decoded():
    data, at, kept = FRAMES[0].tobytes(), 2, b"\xff\xd8"
    while data[at + 1] != 0xDA:  # start of the scan; before it come segments with their lengths
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        kept += b"" if data[at + 1] == 0xC4 else data[at:end]
        at = end
    kept += data[at:]
    assert len(kept) < len(data) - 100
    raw = np.frombuffer(kept, np.uint8).reshape(1, -1)
    assert np.array_equal(frame_image(raw, "MJPG", 640, 480), frame_image(FRAMES[0], "MJPG", 640, 480))


def test_a_frame_of_bytes_in_a_row_is_an_image_too():
    """As newer versions of OpenCV hand on every format that they do not convert."""
    assert np.array_equal(frame_image(COLOR.reshape(1, -1), "YUYV", 6, 4), COLOR[:, :, 0])
