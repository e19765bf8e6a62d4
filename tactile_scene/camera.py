"""Camera: what every driver of a tactile sensor's camera offers, simulated or real.

A driver is a class in the registry `CAMERAS`, made as an arm driver is (`tactile_scene.arm`); another
package adds its own by an entry point of the group "tactile_servoing.cameras"::

    class MyCamera:
        settings_class = MyCameraSettings            # checked against `camera_settings` of the scene

        def __init__(self, arm: ArmScene, settings: MyCameraSettings, report: Callable[[CameraFrame], None]):
            ...                                      # connect; then report(frame) for each exposure
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from tactile_base.contract import Contract
from tactile_base.registry import Registry
from tactile_base.settings import SettingError, Settings, setting
from tactile_base.stamps import SECOND_NS
from tactile_scene.scene import ArmScene

RAW, COMPRESSED = "raw", "compressed"


@dataclass(frozen=True)
class ExternalCameraSettings(Settings):
    """What a scene says of a camera whose node runs already."""

    transport: str = setting(
        RAW,
        choices=(RAW, COMPRESSED),
        doc="images are taken from tactile/image, or as JPEG or PNG from tactile/image/compressed",
    )


@dataclass(frozen=True)
class CameraFrame:
    """One exposure.

    Attributes
    ----------
    stamp_ns : int
        Time in the middle of the exposure, ns of ROS time.
    image : ndarray (height, width) or (height, width, 3), uint8
        Gray, or blue, green and red.
    lost : int
        Exposures known to be lost since the start.
    """

    stamp_ns: int
    image: NDArray[np.uint8]
    lost: int = 0


@dataclass(frozen=True)
class CameraStatus:
    """What a driver says of itself, for its user.

    Attributes
    ----------
    fault : str
        Why no frames come; empty while they do.
    remarks : tuple of str
        What is not as the settings want it, as a control that the device does not have.
    values : mapping
        Names and values for /diagnostics.
    """

    fault: str = ""
    remarks: tuple[str, ...] = ()
    values: Mapping[str, str] = field(default_factory=dict)


class Camera(Protocol):
    """A driver that has been opened.

    It may also have a property `status`, a `CameraStatus`, which is asked for a few times a second.
    """

    @property
    def rate(self) -> float:
        """Exposures a second, Hz."""

    def close(self) -> None:
        """Let go of the camera; no frame is reported after it returns."""


class CameraDriver(Protocol):
    """What an entry of `CAMERAS` is.

    Called with the arm of the scene whose sensor it is, the driver's own settings, and what to call with each
    frame, from any thread. Raises `OSError` or `RuntimeError` if the camera cannot be had.
    """

    settings_class: ClassVar[type[Settings]]

    def __call__(self, arm: ArmScene, settings: Any, report: Callable[[CameraFrame], None]) -> Camera: ...


#: Camera drivers by name, besides the simulated cell's.
CAMERAS: Registry[CameraDriver] = Registry(
    "camera driver",
    "tactile_servoing.cameras",
    {
        "uvc": "tactile_drivers.uvc_camera:UvcCamera",
        "digit": "tactile_drivers.gel_cameras:DigitCamera",
        "gelsight_mini": "tactile_drivers.gel_cameras:GelSightMiniCamera",
        "replay": "tactile_drivers.replay_camera:ReplayCamera",
    },
    Contract(("arm", "settings", "report"), {"close": ()}, settings=True),
)


def open_camera(arm: ArmScene, report: Callable[[CameraFrame], None]) -> Camera:
    """The camera of an arm's sensor, driven by the driver that the scene names.

    Frames are reported with the sensor's `time_offset` added to their stamps.

    Raises
    ------
    SettingError
        If the arm has no sensor, there is no such driver, or `camera_settings` hold what it does not know.
    OSError, RuntimeError
        If the driver cannot have the camera.
    """
    if arm.sensor is None:
        raise SettingError(f"arm '{arm.name}' has no sensor in this scene")
    driver = CAMERAS.load(arm.sensor.camera)
    given = arm.sensor.camera_settings
    shift_ns = round(arm.sensor.settings.time_offset * SECOND_NS)

    def shifted(frame: CameraFrame) -> None:
        there = isinstance(frame, CameraFrame)  # else whoever takes it refuses it
        report(replace(frame, stamp_ns=frame.stamp_ns + shift_ns) if there else frame)

    settings = given.checked(driver.settings_class, given.values)
    return driver(arm, settings, shifted if shift_ns else report)
