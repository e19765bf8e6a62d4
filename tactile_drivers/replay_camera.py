"""Camera driver `replay`: a video file or a folder of images in place of a camera, at the scene's rate.

Stamps are those of now: a picture counts as exposed when it is shown. The times in a video are not looked at.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from tactile_base.settings import Settings, setting
from tactile_drivers.camera_frames import Pixels
from tactile_scene.camera import CameraFrame, CameraStatus

if TYPE_CHECKING:
    from tactile_scene.scene import ArmScene

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp")


@dataclass(frozen=True)
class ReplayCameraSettings(Settings):
    """What a scene says of a recording; the rate is the sensor's `camera_rate`."""

    path: str = setting("", doc="a video file or a folder of images, seen from the scene's folder")
    color: bool = setting(False, doc="images in blue, green and red (bgr8); else gray (mono8)")
    loop: bool = setting(True, doc="begin again at the end; else there are no more frames then")


class ReplayCamera:
    """See the module's text."""

    settings_class = ReplayCameraSettings

    def __init__(
        self, arm: ArmScene, settings: ReplayCameraSettings, report: Callable[[CameraFrame], None]
    ) -> None:
        assert arm.sensor is not None
        self.rate = arm.sensor.settings.camera_rate
        self._path = arm.sensor.camera_settings.path.parent / settings.path
        self._loop, self._color, self._report = settings.loop, settings.color, report
        self._shown = self._late = 0
        self._fault = ""
        if next(pictures(self._path, settings.color), None) is None:
            raise OSError(f"{self._path}: is no video that can be read, and no folder of images")
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def status(self) -> CameraStatus:
        """See `Camera`."""
        values = {"recording": self._path, "frames shown": self._shown, "frames lost": self._late}
        return CameraStatus(self._fault, (), {name: str(value) for name, value in values.items()})

    def close(self) -> None:
        """Show no more."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        due = time.monotonic()
        while True:
            shown = self._shown
            for picture in pictures(self._path, self._color):
                due += 1.0 / self.rate
                late = int((time.monotonic() - due) * self.rate)
                if late > 0:  # slower than the rate: time goes on, no picture is left out
                    self._late, due = self._late + late, due + late / self.rate
                if self._closing.wait(max(0.0, due - time.monotonic())):
                    return
                self._report(CameraFrame(time.time_ns(), picture, self._late))
                self._shown += 1
            if not self._loop or self._shown == shown:
                self._fault = f"{self._path}: ended after {self._shown} frames"
                return


def pictures(path: Path, color: bool = False) -> Iterator[Pixels]:
    """Pictures, gray or in color, of a video file, or of a folder by the numbers in their names."""
    if path.is_dir():
        names = (n for n in path.iterdir() if n.suffix.lower() in SUFFIXES and n.is_file())
        how = cv2.IMREAD_COLOR if color else cv2.IMREAD_GRAYSCALE
        found = (cv2.imread(str(name), how) for name in sorted(names, key=_order))
        yield from (np.asarray(picture, np.uint8) for picture in found if picture is not None)
    elif path.is_file():
        capture = cv2.VideoCapture(str(path))
        try:
            while (read := capture.read())[0]:
                picture = read[1]
                if color != (picture.ndim == 3):
                    picture = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR if color else cv2.COLOR_BGR2GRAY)
                yield np.asarray(picture, np.uint8)
        finally:
            capture.release()


def _order(path: Path) -> list[tuple[int, str]]:
    """image_2 before image_10."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", path.name)]
