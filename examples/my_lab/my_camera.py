"""A camera driver: a video device, or an image that stands in for one."""

import threading
import time
from dataclasses import dataclass

import cv2

from tactile_base.settings import Settings, setting
from tactile_scene.camera import CameraFrame


@dataclass(frozen=True)
class MyCameraSettings(Settings):
    device: str = setting("/dev/video0", doc="a video device, or an image file that stands in for one")
    delay: float = setting(0.012, lower=0.0, upper=1.0, unit="s", doc="from exposure to this computer")


class MyCamera:
    settings_class = MyCameraSettings

    def __init__(self, arm, settings, report):
        self.rate = arm.sensor.settings.camera_rate
        self._device, self._delay, self._report = settings.device, settings.delay, report
        self._still = cv2.imread(settings.device, cv2.IMREAD_GRAYSCALE)
        self._video = cv2.VideoCapture(settings.device) if self._still is None else None
        if self._video is not None and not self._video.isOpened():
            raise OSError(f"{settings.device}: no camera and no image")
        self._open = True
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self):
        self._open = False
        self._thread.join()

    def _run(self):
        while self._open:
            if self._video is None:
                time.sleep(1.0 / self.rate)
                self._report(CameraFrame(time.time_ns(), self._still))
                continue
            there, image = self._video.read()  # waits for the next frame
            stamp_ns = time.time_ns() - int(self._delay * 1e9)
            if there:
                self._report(CameraFrame(stamp_ns, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)))
