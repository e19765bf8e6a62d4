"""Camera driver `uvc`: a USB camera by OpenCV and V4L2, with its settings pinned and read back.

Format, size and rate that the device does not take are an error, since images would be others than the
scene says. Exposure, gain, white balance and focus that it does not take are told. A device that is unplugged
is told at once; it is opened again when it is there again, or not, as `reconnect` says. Its settings are then
pinned anew.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import cv2

from tactile_base.settings import Settings, setting
from tactile_drivers.camera_frames import FORMATS, Arrival, FrameIntake, Pixels
from tactile_drivers.video_devices import holders, objection
from tactile_scene.camera import CameraFrame, CameraStatus

if TYPE_CHECKING:
    from tactile_scene.scene import ArmScene

RETRY = 0.5  # s, between attempts to open a device again
SILENT = 0.25  # s without a usable frame that are told
JOIN = 3.0  # s; a read of a device that hangs returns after `_HANG`
_HANG = "1"  # s
_MANUAL, _AUTOMATIC = 1, 3  # of V4L2_CID_EXPOSURE_AUTO: manual, aperture priority
_EXPOSURE_UNIT = 1e-4  # s, of V4L2_CID_EXPOSURE_ABSOLUTE
_UNKNOWN = -1.0  # what OpenCV reads of a control that a device does not have


Control = tuple[str, int, float]  # name, OpenCV's number, value


class Capture(Protocol):
    """What is used of `cv2.VideoCapture`."""

    def isOpened(self) -> bool: ...
    def set(self, control: int, value: float) -> bool: ...
    def get(self, control: int) -> float: ...
    def grab(self) -> bool: ...
    def retrieve(self) -> tuple[bool, Any]: ...
    def release(self) -> None: ...


@dataclass(frozen=True)
class UvcCameraSettings(Settings):
    """What a scene says of a USB camera; the rate is the sensor's `camera_rate`."""

    device: str = setting(
        "/dev/video0", doc="path of the device; one below /dev/v4l/by-id stays when it is plugged in again"
    )
    format: str = setting("MJPG", choices=FORMATS, doc="of the device's frames")
    color: bool = setting(False, doc="images in blue, green and red (bgr8); else gray (mono8)")
    width: int = setting(640, unit="px", lower=16, upper=8192, doc="of the images")
    height: int = setting(480, unit="px", lower=16, upper=8192, doc="of the images")
    exposure: float = setting(0.008, unit="s", lower=0.0, upper=1.0, doc="time of exposure; 0: automatic")
    gain: float = setting(-1.0, lower=-1.0, upper=1e6, doc="in the device's own unit; -1: left as it is")
    white_balance: float = setting(
        4600.0, unit="K", lower=0.0, upper=20000.0, doc="color temperature; 0: automatic"
    )
    focus: float = setting(
        -1.0, lower=-1.0, upper=1e6, doc="in the device's own unit; -1: left as it is, never automatic"
    )
    delay: float = setting(
        0.0, unit="s", lower=-0.1, upper=1.0, doc="from the middle of an exposure to the stamp of its frame"
    )
    least_contrast: float = setting(
        4.0, lower=0.0, upper=255.0,
        doc="standard deviation of gray levels below which an image shows nothing and is refused; 0: none is",
    )  # fmt: skip
    repeats: bool = setting(False, doc="take a frame that equals the one before it bit for bit")
    reconnect: bool = setting(True, doc="open a device that was unplugged when it is there again")

    def controls(self) -> Iterator[Control]:
        """Name, control and value; what is automatic is switched off before its value is set."""
        automatic = self.exposure == 0.0
        yield "automatic exposure (1: off)", cv2.CAP_PROP_AUTO_EXPOSURE, _AUTOMATIC if automatic else _MANUAL
        if not automatic:
            yield "exposure (0.1 ms)", cv2.CAP_PROP_EXPOSURE, round(self.exposure / _EXPOSURE_UNIT)
        if self.gain >= 0.0:
            yield "gain", cv2.CAP_PROP_GAIN, self.gain
        automatic = self.white_balance == 0.0
        yield "automatic white balance (0: off)", cv2.CAP_PROP_AUTO_WB, float(automatic)
        if not automatic:
            yield "white balance (K)", cv2.CAP_PROP_WB_TEMPERATURE, self.white_balance
        yield "automatic focus (0: off)", cv2.CAP_PROP_AUTOFOCUS, 0.0
        if self.focus >= 0.0:
            yield "focus", cv2.CAP_PROP_FOCUS, self.focus


def open_v4l2(device: str) -> Capture:
    """A device, opened; raises `OSError` that says why it cannot be."""
    path = Path(device)
    why = objection(path)
    if why:
        raise OSError(why)
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", _HANG)
    capture = cv2.VideoCapture(device, cv2.CAP_V4L2)
    if not capture.isOpened():
        capture.release()
        others = ", ".join(holders(path))
        raise OSError(
            f"{device}: {f'is in use by {others}' if others else 'is in use by another program'}, or "
            "gives no images (`tactile camera list` shows which devices do)"
        )
    return capture


class UvcCamera:
    """See the module's text; `open_device` is for doubles of a device."""

    settings_class: ClassVar[type[UvcCameraSettings]] = UvcCameraSettings

    def __init__(
        self,
        arm: ArmScene,
        settings: UvcCameraSettings,
        report: Callable[[CameraFrame], None],
        open_device: Callable[[str], Capture] = open_v4l2,
    ) -> None:
        assert arm.sensor is not None
        self.rate = arm.sensor.settings.camera_rate
        self.settings, self._report, self._open_device = settings, report, open_device
        self._remarks: tuple[str, ...] = ()
        self._gone, self._returns = "", 0
        self._closing, self._lock = threading.Event(), threading.Lock()
        self._intake = self._new_intake(0)
        capture = self._open()
        self._last_frame = time.monotonic()
        self._thread = threading.Thread(target=self._run, args=(capture,), daemon=True)
        self._thread.start()

    @property
    def status(self) -> CameraStatus:
        """See `Camera`."""
        silence = time.monotonic() - self._last_frame
        fault = self._gone
        if not fault and silence > SILENT:
            why = self._intake.last_refusal or "the device gives nothing"
            fault = f"{self.settings.device}: no frame for {silence:.1f} s: {why}"
        return CameraStatus(fault, self._remarks, self._values())

    def close(self) -> None:
        """Let go of the device; a read that hangs is not waited for longer than `JOIN`."""
        with self._lock:
            self._closing.set()
        self._thread.join(JOIN)

    # ---- the device ----

    def _open(self) -> Capture:
        """The device with its settings pinned; what it does not take is in the remarks, or an `OSError`."""
        capture = self._open_device(self.settings.device)
        try:
            self._remarks = tuple(pinned(capture, self.settings, self.rate))
        except OSError:
            capture.release()
            raise
        return capture

    def _new_intake(self, lost: int) -> FrameIntake:
        s = self.settings
        checks = s.delay, s.least_contrast, s.repeats
        return FrameIntake(s.width, s.height, s.format, self.rate, *checks, s.color, lost)

    def _run(self, capture: Capture | None) -> None:
        while capture is not None:
            self._stream(capture)
            capture.release()
            capture = self._opened_again() if self.settings.reconnect else None

    def _stream(self, capture: Capture) -> None:
        """Report frames until the driver is closed, or the device is gone."""
        while not self._closing.is_set() and capture.grab():
            arrival = Arrival.now()
            there, raw = capture.retrieve()
            if there:
                self._take(raw, capture.get(cv2.CAP_PROP_POS_MSEC), arrival)
        again = "waiting for it" if self.settings.reconnect else "reconnect is false: start the node anew"
        self._gone = f"{self.settings.device}: unplugged, or silent for {_HANG} s; {again}"

    def _take(self, raw: Pixels, position_ms: float, arrival: Arrival) -> None:
        frame = self._intake.take(raw, position_ms, arrival)
        if frame is None:
            return
        with self._lock:
            if not self._closing.is_set():
                self._gone, self._last_frame = "", time.monotonic()
                self._report(frame)

    def _opened_again(self) -> Capture | None:
        """The device once it is there again; None when the driver is closed before."""
        gone = self._gone
        while not self._closing.wait(RETRY):
            try:
                capture = self._open()
            except OSError as error:
                self._gone = f"{gone}: {error}"
                continue
            # what was exposed meanwhile nobody knows: the count of lost ones goes on from here
            refused, self._intake = self._intake.refused, self._new_intake(self._intake.lost)
            self._intake.refused = refused
            self._returns += 1
            self._gone, self._last_frame = "", time.monotonic()
            return capture
        return None

    def _values(self) -> dict[str, str]:
        intake = self._intake
        values = {
            "device": self.settings.device,
            "stamps": intake.clock.source or "none yet",
            "frames lost": str(intake.lost),
            "times plugged in again": str(self._returns),
        }
        refused = sorted(dict(intake.refused).items())
        values |= {f"frames refused, {why}": str(count) for why, count in refused}
        if (found := intake.intervals()) is not None:
            rate, *deviations = found
            spread, largest = (f"{1e3 * each:.3f}" for each in deviations)
            values["rate, measured (Hz)"] = f"{rate:.2f}"
            values["interval, standard and largest deviation (ms)"] = f"{spread} {largest}"
        return values


def pinned(capture: Capture, settings: UvcCameraSettings, rate: float) -> Iterator[str]:
    """Set what the settings want, and read it back: remarks on what the device did not take.

    Raises
    ------
    OSError
        If it gives images of another format or size, or at another rate.
    """
    code = cv2.VideoWriter.fourcc(*settings.format)
    wanted = [
        (cv2.CAP_PROP_FOURCC, code),
        (cv2.CAP_PROP_FRAME_WIDTH, settings.width),
        (cv2.CAP_PROP_FRAME_HEIGHT, settings.height),
        (cv2.CAP_PROP_FPS, rate),
        (cv2.CAP_PROP_CONVERT_RGB, 0),
    ]
    for control, value in wanted:
        capture.set(control, value)
    _check_stream(capture, settings, rate)
    for name, control, value in settings.controls():
        capture.set(control, value)
        found = capture.get(control)
        if found == _UNKNOWN:
            yield f"{name}: the device has no such control"
        elif abs(found - value) > max(0.5, 0.01 * abs(value)):
            yield f"{name}: {value:g} was asked, the device keeps {found:g}"


def _check_stream(capture: Capture, settings: UvcCameraSettings, rate: float) -> None:
    width, height = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    code = int(capture.get(cv2.CAP_PROP_FOURCC))
    form = code.to_bytes(4, "little", signed=code < 0).decode("ascii", "replace").strip()
    given = capture.get(cv2.CAP_PROP_FPS)
    asked = f"{settings.format} {settings.width}x{settings.height}"
    if (form, width, height) != (settings.format, settings.width, settings.height):
        raise OSError(
            f"{settings.device}: {asked} was asked, the device gives {form} {width}x{height}; "
            "`tactile camera list` shows what it offers"
        )
    if given > 0 and abs(given - rate) > max(0.5, 0.02 * rate):
        raise OSError(
            f"{settings.device}: {rate:g} Hz were asked of {asked}, the device gives {given:g}: "
            "set camera_rate to that, or another format or size (`tactile camera list`)"
        )
