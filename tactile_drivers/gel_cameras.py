"""Camera drivers `digit` and `gelsight_mini`: gel sensors that one can buy, found by their serial numbers.

Both are USB cameras, and all of `uvc_camera` holds. Sizes, rates, light and how a device is told from others
are those of the makers' own programs: facebookresearch/digit-interface (`digit.py`, `digit_handler.py`) and
gelsightinc/gsrobotics (`utilities/gelsightmini.py`, `default_config.json`). They leave exposure and white
balance to the device, and so does this.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import cv2

from tactile_base.settings import setting
from tactile_drivers.camera_frames import FORMATS
from tactile_drivers.uvc_camera import Capture, Control, UvcCamera, UvcCameraSettings, open_v4l2
from tactile_drivers.video_devices import BY_ID
from tactile_scene.camera import CameraFrame

if TYPE_CHECKING:
    from tactile_scene.scene import ArmScene

_FULL_LIGHT = 15  # of each color


@dataclass(frozen=True)
class GelCameraSettings(UvcCameraSettings):
    """What a scene says of a gel sensor, which need be no more than its serial number."""

    device: str = setting("", doc="path of the device; empty: found by its model and serial number")
    serial: str = setting("", doc="serial number, as `tactile camera list` shows it; empty: the only one")
    color: bool = setting(True, doc="images in blue, green and red (bgr8); else gray (mono8)")
    width: int = setting(320, unit="px", lower=16, upper=8192, doc="of the images")
    height: int = setting(240, unit="px", lower=16, upper=8192, doc="of the images")
    exposure: float = setting(0.0, unit="s", lower=0.0, upper=1.0, doc="time of exposure; 0: automatic")
    white_balance: float = setting(
        0.0, unit="K", lower=0.0, upper=20000.0, doc="color temperature; 0: automatic"
    )


@dataclass(frozen=True)
class DigitCameraSettings(GelCameraSettings):
    """A DIGIT: 320x240 at 30 or 60 Hz, 640x480 at 15 or 30 Hz."""

    format: str = setting("YUYV", choices=FORMATS, doc="of the device's frames")
    light: tuple[int, ...] = setting(
        (_FULL_LIGHT,) * 3, lower=0, upper=_FULL_LIGHT, length=3, doc="of the red, green and blue lamps"
    )

    def controls(self) -> Iterator[Control]:
        """And the lamps, for which the device uses the control of a zoom."""
        yield from super().controls()
        red, green, blue = self.light
        yield "light (RGB)", cv2.CAP_PROP_ZOOM, red << 8 | green << 4 | blue


@dataclass(frozen=True)
class GelSightMiniCameraSettings(GelCameraSettings):
    """A GelSight Mini: 320x240 as in its maker's programs, up to 3280x2464."""


class GelCamera(UvcCamera):
    """A USB camera of a model that is found."""

    model: ClassVar[str]

    def __init__(
        self,
        arm: ArmScene,
        settings: GelCameraSettings,
        report: Callable[[CameraFrame], None],
        open_device: Callable[[str], Capture] = open_v4l2,
        by_id: Path = BY_ID,
    ) -> None:
        if not settings.device:
            settings = settings.replaced(device=str(find(self.model, settings.serial, by_id)))
        super().__init__(arm, settings, report, open_device)


class DigitCamera(GelCamera):
    """See the module's text."""

    settings_class, model = DigitCameraSettings, "DIGIT"


class GelSightMiniCamera(GelCamera):
    """See the module's text."""

    settings_class, model = GelSightMiniCameraSettings, "GelSight_Mini"


def find(model: str, serial: str, by_id: Path = BY_ID) -> Path:
    """The lasting path of a sensor, in which udev has put maker, model and serial number.

    Raises `OSError` where there is none, or several and no serial number.
    """
    there = sorted(by_id.glob(f"usb-*{model}*-video-index0"))
    found = [path for path in there if serial in path.name]
    if len(found) == 1:
        return found[0]
    what = f"{model.replace('_', ' ')}{f' with the serial number {serial}' if serial else ''}"
    names = ", ".join(path.name for path in found or there) or f"nothing of that model in {by_id}"
    right = "name one by its serial number (camera_settings: {serial: ..})" if found else "is it plugged in?"
    raise OSError(f"{'several' if found else 'no'} {what}: there is {names}; {right}")
