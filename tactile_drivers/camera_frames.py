"""Frames of a video device as exposures, with their time in ROS time, or refused and counted.

What is refused is not published, so that the arm stops as it does when a camera falls silent: a frame that is
torn or damaged inside, of another size, without anything to see on it (a dark lamp, a covered lens), equal to
the one before it bit for bit (a frozen camera: no two exposures are equal), or stamped with a time that
cannot be. Perception looks for most of it again, since not every image comes from here
(`tactile_base.exposures`).
"""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_base.exposures import DamagedJpeg, Exposures, objection, pixels_of_jpeg
from tactile_base.stamps import SECOND_NS
from tactile_scene.camera import CameraFrame

Pixels = NDArray[np.uint8]
MONOTONIC, REALTIME, ARRIVAL = "kernel, CLOCK_MONOTONIC", "kernel, CLOCK_REALTIME", "arrival in this program"
#: Formats of a device whose frames can be made gray without making colors first, or become colors.
FORMATS = ("MJPG", "YUYV", "UYVY", "GREY", "NV12")
_LUMA_BYTE = {"YUYV": 0, "UYVY": 1}
#: OpenCV's conversions to blue, green and red.
_COLORS = {
    "YUYV": cv2.COLOR_YUV2BGR_YUYV,
    "UYVY": cv2.COLOR_YUV2BGR_UYVY,
    "GREY": cv2.COLOR_GRAY2BGR,
    "NV12": cv2.COLOR_YUV2BGR_NV12,
}
_OLDEST, _AHEAD = SECOND_NS, 5_000_000  # ns; ages of a frame's stamp that can be, when it has just arrived
_STRANGE = 10  # frames stamped by no clock that is known, until it is the device's own
_TOGETHER, _READINGS = 20_000, 5  # ns between two readings of a clock; attempts at less
_WINDOW = 240  # frames over which rate and intervals are told


class FrameRefused(ValueError):
    """A frame that is no exposure, and why."""


@dataclass(frozen=True)
class Arrival:
    """When a frame has arrived, ns: on the steady clock (CLOCK_MONOTONIC), and in ROS time."""

    steady_ns: int
    now_ns: int

    @classmethod
    def now(cls) -> Arrival:
        """Both clocks at one moment; they are read again where the program was held up in between."""
        readings = []
        for _ in range(_READINGS):
            before, now, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
            readings.append((after - before, cls((before + after) // 2, now)))
            if after - before < _TOGETHER:
                break
        return min(readings, key=lambda reading: reading[0])[1]


class StampClock:
    """Time of exposure in ROS time, by the device's own stamps where there are any.

    Drivers of UVC devices stamp a frame by CLOCK_MONOTONIC, some by CLOCK_REALTIME, when its first bytes
    arrive; others do not. The first frames show which it is: a stamp that is a second old at most. The age by
    that clock is what is subtracted from ROS time, so that a clock that is set is followed at once.

    Attributes
    ----------
    source : str
        What the stamps come from; empty before the first frame.
    """

    def __init__(self) -> None:
        self.source, self._strange = "", 0

    def exposed_ns(self, position_ms: float, arrival: Arrival) -> int:
        """Stamp of a frame, ns of ROS time; raises `FrameRefused` for one that cannot be.

        `position_ms` is what the device says (`cv2.CAP_PROP_POS_MSEC`), in ms.
        """
        stamp_ns = round(position_ms * 1e6)
        ages = {MONOTONIC: arrival.steady_ns - stamp_ns, REALTIME: arrival.now_ns - stamp_ns}
        if not self.source:
            near = [source for source, age in ages.items() if -_AHEAD <= age <= _OLDEST]
            self._strange += not near
            if not near and stamp_ns > 0 and self._strange < _STRANGE:  # or this program was held up
                raise FrameRefused("it is not known by which clock")
            self.source = near[0] if near else ARRIVAL
        age = ages.get(self.source, 0)
        if not -_AHEAD <= age <= _OLDEST:
            raise FrameRefused(f"its stamp is {age * 1e-9:.3f} s before its arrival")
        return arrival.now_ns - age


@dataclass
class FrameIntake:
    """Takes the frames of one stream of a device, one after the other.

    Attributes
    ----------
    width, height : of the images, px
    form : format of the device's frames, one of `FORMATS`
    rate : exposures a second, Hz
    delay : from the middle of an exposure to its stamp, s
    least_contrast : smallest standard deviation of gray levels of an image; 0: any
    repeats : whether a frame that equals the one before is one
    color : whether images are blue, green and red, else gray
    lost : exposures that are missing, by the gaps between stamps
    """

    width: int
    height: int
    form: str
    rate: float
    delay: float = 0.0
    least_contrast: float = 0.0
    repeats: bool = False
    color: bool = False
    lost: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    last_refusal: str = ""
    clock: StampClock = field(default_factory=StampClock)

    def __post_init__(self) -> None:
        self._exposures = Exposures()
        self._stamps: deque[int] = deque(maxlen=_WINDOW)

    def take(self, raw: Pixels, position_ms: float, arrival: Arrival) -> CameraFrame | None:
        """The exposure in a frame of the device; None if it is refused."""
        try:
            stamp_ns = self._stamp(position_ms, arrival)
            image = self._image(raw)
        except FrameRefused as error:
            self.last_refusal = str(error)
            self.refused[self.last_refusal.split(":")[0]] += 1
            return None
        if self._stamps:
            missing = round((stamp_ns - self._stamps[-1]) / SECOND_NS * self.rate) - 1
            self.lost += max(0, missing)
        self._stamps.append(stamp_ns)
        return CameraFrame(stamp_ns, image, self.lost)

    def intervals(self) -> tuple[float, float, float] | None:
        """Rate (Hz), standard deviation and largest deviation from their mean (s) of the last intervals."""
        stamps = np.array(list(self._stamps), dtype=np.int64)
        if len(stamps) < 3:
            return None
        steps = np.diff(stamps) / SECOND_NS
        mean = float(steps.mean())
        return 1.0 / mean, float(steps.std()), float(np.abs(steps - mean).max())

    def _stamp(self, position_ms: float, arrival: Arrival) -> int:
        try:
            stamp_ns = self.clock.exposed_ns(position_ms, arrival) - round(self.delay * SECOND_NS)
        except FrameRefused as error:
            raise FrameRefused(f"stamped wrongly: {error}") from error
        if self._stamps and stamp_ns <= self._stamps[-1]:
            late = (self._stamps[-1] - stamp_ns) * 1e-6
            raise FrameRefused(f"stamped wrongly: its stamp is {late:.3f} ms before that of the last frame")
        return stamp_ns

    def _image(self, raw: Pixels) -> Pixels:
        repeated = "" if self.repeats else self._exposures.repeats(raw)
        image = frame_image(raw, self.form, self.width, self.height, self.color)
        if why := objection(image, self.least_contrast) or repeated:
            raise FrameRefused(why)
        return image


def frame_image(raw: Pixels, form: str, width: int, height: int, color: bool = False) -> Pixels:
    """A frame in the device's own format as a gray image (height, width), or in color (height, width, 3).

    For a gray one the luma of Y'UV is taken as it is, of a JPEG the luma alone is decoded: colors would cost
    several times as much and be thrown away.

    Raises
    ------
    FrameRefused
        If it is torn, damaged inside, or of another size.
    """
    if form == "MJPG":
        try:
            image = pixels_of_jpeg(raw, color)
        except DamagedJpeg as error:
            raise FrameRefused(f"torn: {error}") from error
    else:
        rows = height * 3 // 2 if form == "NV12" else height
        channels = 2 if form in _LUMA_BYTE else 1
        if raw.dtype != np.uint8 or raw.size != rows * width * channels:
            what = f"{raw.dtype} {raw.shape} is no {form} of {width}x{height} pixels"
            raise FrameRefused(f"of another size: {what}")
        cells = raw.reshape(rows, width, channels)
        if color:
            image = np.asarray(cv2.cvtColor(cells, _COLORS[form]), np.uint8)
        else:
            image = np.ascontiguousarray(cells[:height, :, _LUMA_BYTE.get(form, 0)])
    if image.shape[:2] != (height, width):
        found = f"{image.shape[1]}x{image.shape[0]}"
        raise FrameRefused(f"of another size: {found} pixels, must be {width}x{height}")
    return image
