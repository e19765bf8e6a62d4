"""A USB camera that is not there: the interface of `cv2.VideoCapture`, frames made here, faults on demand."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from tactile_base.settings import setting
from tactile_drivers.uvc_camera import UvcCamera, UvcCameraSettings

WIDTH, HEIGHT = 640, 480
BUFFERS = 4  # as many as OpenCV has of a device
#: Which clock stamps a frame -> what it is ahead of CLOCK_MONOTONIC, s.
CLOCKS = {"monotonic": 0.0, "realtime": time.time() - time.monotonic(), "none": None}


NOISE = np.random.default_rng(0).integers(0, 8, WIDTH * HEIGHT, dtype=np.uint8)


def noisy(image: np.ndarray, number: int) -> np.ndarray:
    """The image with noise of its own for each number, as no two exposures are equal."""
    noise = np.roll(NOISE, 7 * number)[: image.size].reshape(image.shape)
    return np.minimum(image, 247) + noise


def discs(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Bright discs on dark."""
    image = np.full((height, width), 40, np.uint8)
    for x in range(60, width - 40, 40):
        for y in range(60, height - 40, 40):
            cv2.circle(image, (x, y), 8, 200, -1, cv2.LINE_AA)
    return image


def picture(number: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Discs, with noise of its own for each number."""
    return noisy(discs(width, height), number)


def jpeg(image: np.ndarray) -> np.ndarray:
    """As OpenCV hands on the frames of a device in MJPG that it does not decode."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].reshape(1, -1)


FRAMES = [jpeg(picture(number)) for number in range(4)]


@dataclass
class Device:
    """The camera itself, which stays what it is while it is opened and closed.

    Attributes
    ----------
    stamps : which clock stamps a frame, of `CLOCKS`
    keeps : control -> the value that the device keeps whatever is set; None: it has no such control
    faults : what is wrong with the frame of a number since the device was made: "black", "frozen", "torn",
        "small", "early" (stamped 2 s ago), "drop" (never comes), or nothing
    jitter : by which a stamp strays, standard deviation, s
    scene : what it exposes, with new noise in each frame
    """

    rate: float = 60.0
    stamps: str = "monotonic"
    keeps: dict[int, float | None] = field(default_factory=dict)
    faults: Callable[[int], str] = lambda number: ""
    jitter: float = 0.0
    plugged: bool = True
    busy: bool = False
    opened: int = 0
    number: int = 0
    scene: np.ndarray = field(default_factory=discs)

    def open(self, path: str) -> Capture:
        if not self.plugged:
            raise OSError(f"{path}: there is no such device; devices: none")
        if self.busy:
            raise OSError(f"{path}: is in use by another program")
        self.opened += 1
        return Capture(self)


class Capture:
    """What `cv2.VideoCapture` is, as far as the driver uses it."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.controls: dict[int, float] = {}
        self.due = time.monotonic()
        self.released = False
        self.noise = np.random.default_rng(1)

    def isOpened(self):
        return not self.released

    def set(self, control, value):
        if control in self.device.keeps:
            return False
        self.controls[control] = float(value)
        return True

    def get(self, control):
        if control == cv2.CAP_PROP_POS_MSEC:
            return self.stamp * 1e3
        if control in self.device.keeps:
            kept = self.device.keeps[control]
            return -1.0 if kept is None else kept
        return self.controls.get(control, -1.0)

    def grab(self):
        while True:
            self.due += 1.0 / self.device.rate
            if time.monotonic() - self.due > BUFFERS / self.device.rate:
                continue  # no buffer was free: the kernel drops the frame
            time.sleep(max(0.0, self.due - time.monotonic()))
            if not self.device.plugged:
                return False
            self.device.number += 1
            self.fault = self.device.faults(self.device.number)
            if self.fault != "drop":
                break
        clock = CLOCKS[self.device.stamps]  # the device ticks evenly, the program is woken late
        self.stamp = 0.0 if clock is None else self.due + clock + self.noise.normal(0.0, self.device.jitter)
        if self.fault == "early":
            self.stamp -= 2.0
        return True

    def retrieve(self):
        number = self.device.number
        if self.fault == "torn":
            return True, jpeg(noisy(self.device.scene, number))[:, :2000]
        if self.fault == "black":
            return True, jpeg(picture(number) // 100)
        if self.fault == "small":
            return True, jpeg(picture(number, 320, 240))
        return True, jpeg(noisy(self.device.scene, 0 if self.fault == "frozen" else number))

    def release(self):
        self.released = True


@dataclass(frozen=True)
class DoubleCameraSettings(UvcCameraSettings):
    """Those of the driver, and what happens to the device in a node of its own process."""

    unplugged: str = setting("", doc="a file; as long as it is there the device is not")
    image: str = setting("", doc="what it sees; empty: discs")
    jitter: float = setting(0.0, lower=0.0, upper=1.0, unit="s", doc="of its stamps")
    kept_white_balance: float = setting(0.0, lower=0.0, upper=1e4, doc="whatever is asked; 0: what is asked")


class DistantDevice(Device):
    """A device that another process unplugs."""

    def __init__(self, settings: DoubleCameraSettings, rate: float) -> None:
        self.file = Path(settings.unplugged or "nowhere")
        kept = settings.kept_white_balance
        keeps = {cv2.CAP_PROP_WB_TEMPERATURE: kept} if kept else {}
        super().__init__(rate=rate, keeps=keeps, jitter=settings.jitter)
        if settings.image:
            self.scene = cv2.imread(settings.image, cv2.IMREAD_GRAYSCALE)

    @property
    def plugged(self) -> bool:
        return not self.file.exists()

    @plugged.setter
    def plugged(self, value: bool) -> None:
        """As the file says."""


class DoubleCamera(UvcCamera):
    """The driver itself, on a device that is not there."""

    settings_class = DoubleCameraSettings

    def __init__(self, arm, settings, report):
        device = DistantDevice(settings, arm.sensor.settings.camera_rate)
        super().__init__(arm, settings, report, device.open)
