"""Gel sensors that one can buy: which device is meant, its light, and images in color."""

import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from other_package.double_camera import Device

from tactile_drivers.gel_cameras import DigitCamera, DigitCameraSettings, GelSightMiniCamera, find
from tactile_drivers.uvc_camera import pinned
from tactile_scene.camera import CAMERAS
from tactile_scene.scene import SensorSettings

DIGIT = "usb-Facebook_DIGIT_D20542-video-index0"
MINI = "usb-Arducam_GelSight_Mini_R0B_2BND-9KL5_2BND-9KL5-video-index0"


@pytest.fixture
def by_id(tmp_path):
    """The links that udev makes: usb-MAKER_MODEL_SERIAL-video-indexN."""
    for name in (DIGIT, DIGIT.replace("index0", "index1"), DIGIT.replace("D20542", "D20001"), MINI):
        (tmp_path / name).touch()
    return tmp_path


def test_a_sensor_is_found_by_model_and_serial_number(by_id):
    assert find("DIGIT", "D20542", by_id).name == DIGIT
    assert find("GelSight_Mini", "", by_id).name == MINI


@pytest.mark.parametrize(
    "model, serial, complaint",
    [
        ("DIGIT", "", "several DIGIT: there is .*D20001.*D20542.*name one by its serial number"),
        ("DIGIT", "D1", "no DIGIT with the serial number D1: there is .*D20542.*is it plugged in"),
        ("GelSight_Max", "", "no GelSight Max: there is nothing of that model in"),
    ],
)
def test_which_is_not_there_or_not_clear_is_told_with_what_is_there(by_id, model, serial, complaint):
    with pytest.raises(OSError, match=complaint):
        find(model, serial, by_id)


ARM = SimpleNamespace(sensor=SimpleNamespace(settings=SensorSettings(camera_rate=60.0)))
SCENE = np.full((240, 320, 3), (60, 120, 180), np.uint8)  # blue, green, red
SCENE[100:140, 140:180] = (180, 120, 60)


@pytest.mark.live
def test_a_sensor_gives_images_in_color_and_its_lamps_are_set(by_id):
    device, frames = Device(scene=SCENE), []
    settings = DigitCameraSettings(serial="D20542", format="MJPG", light=(15, 8, 0))
    camera = DigitCamera(ARM, settings, frames.append, device.open, by_id)
    try:
        end = time.monotonic() + 20.0
        while not frames and time.monotonic() < end:
            time.sleep(0.01)
    finally:
        camera.close()
    assert camera.settings.device == str(by_id / DIGIT)
    assert frames[0].image.shape == (240, 320, 3)
    np.testing.assert_allclose(frames[0].image[20, 20].astype(int), SCENE[20, 20], atol=20)
    np.testing.assert_allclose(frames[0].image[120, 160].astype(int), SCENE[120, 160], atol=20)


def test_what_its_maker_leaves_to_the_device_is_left_and_light_is_a_zoom_in_twelve_bits():
    capture = Device().open("double")
    settings = DigitCameraSettings(light=(15, 8, 1))
    assert list(pinned(capture, settings, 60.0)) == []
    assert capture.controls[cv2.CAP_PROP_ZOOM] == 15 * 256 + 8 * 16 + 1
    assert capture.controls[cv2.CAP_PROP_AUTO_EXPOSURE] == 3 and capture.controls[cv2.CAP_PROP_AUTO_WB] == 1
    assert cv2.CAP_PROP_EXPOSURE not in capture.controls
    assert capture.controls[cv2.CAP_PROP_FRAME_WIDTH] == 320


def test_they_are_drivers_by_name():
    assert CAMERAS.load("digit") is DigitCamera and CAMERAS.load("gelsight_mini") is GelSightMiniCamera
