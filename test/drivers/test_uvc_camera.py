"""The driver of USB cameras against a double of a device: pinned settings, unplugging, refusals."""

import itertools
import os
import time
from types import SimpleNamespace

import cv2
import pytest
from other_package.double_camera import Device

from tactile_base.settings import SettingError
from tactile_drivers.uvc_camera import UvcCamera, UvcCameraSettings, open_v4l2, pinned
from tactile_scene.camera import CAMERAS
from tactile_scene.scene import SensorSettings

pytestmark = pytest.mark.live

PATIENCE = 20.0  # s


def arm(rate: float) -> SimpleNamespace:
    """What the driver looks at of an arm of a scene."""
    return SimpleNamespace(sensor=SimpleNamespace(settings=SensorSettings(camera_rate=rate)))


def wait(condition) -> bool:
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and not condition():
        time.sleep(0.005)
    return bool(condition())


@pytest.fixture
def started():
    """Start a camera on a device; returns it, and the frames that it reports."""
    cameras = []

    def start(device: Device, rate: float = 60.0, **settings):
        frames: list = []
        cameras.append(UvcCamera(arm(rate), UvcCameraSettings(**settings), frames.append, device.open))
        return cameras[-1], frames

    yield start
    for camera in cameras:
        camera.close()


def test_the_driver_has_the_name_uvc():
    assert CAMERAS.load("uvc") is UvcCamera


def test_frames_come_gray_with_the_time_of_the_kernel_and_the_rate_is_measured(started):
    camera, frames = started(Device(rate=120.0), rate=120.0)
    assert wait(lambda: len(frames) >= 60)
    now_ns = time.time_ns()
    assert frames[-1].image.shape == (480, 640) and frames[-1].image.ndim == 2
    assert all(0 < now_ns - frame.stamp_ns < 10**10 for frame in frames)
    assert all(b.stamp_ns > a.stamp_ns for a, b in itertools.pairwise(frames))
    values = camera.status.values
    assert values["stamps"] == "kernel, CLOCK_MONOTONIC"
    assert 10.0 < float(values["rate, measured (Hz)"]) < 121.0  # less what a loaded machine loses
    spread, largest = map(float, values["interval, standard and largest deviation (ms)"].split())
    assert 0.0 <= spread <= largest


def test_settings_are_pinned_with_what_is_automatic_off_before():
    capture, settings = (
        Device().open("double"),
        UvcCameraSettings(exposure=0.005, white_balance=5000.0, gain=12.0, focus=30.0),
    )
    assert list(pinned(capture, settings, 60.0)) == []
    wanted = {
        cv2.CAP_PROP_AUTO_EXPOSURE: 1,  # manual
        cv2.CAP_PROP_EXPOSURE: 50,  # of 0.1 ms
        cv2.CAP_PROP_AUTO_WB: 0,
        cv2.CAP_PROP_WB_TEMPERATURE: 5000,
        cv2.CAP_PROP_AUTOFOCUS: 0,
        cv2.CAP_PROP_FOCUS: 30,
        cv2.CAP_PROP_GAIN: 12,
        cv2.CAP_PROP_CONVERT_RGB: 0,  # nobody needs the colors
    }
    assert {control: capture.controls[control] for control in wanted} == wanted
    order = list(capture.controls)
    for automatic, value in (
        (cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_EXPOSURE),
        (cv2.CAP_PROP_AUTO_WB, cv2.CAP_PROP_WB_TEMPERATURE),
        (cv2.CAP_PROP_AUTOFOCUS, cv2.CAP_PROP_FOCUS),
    ):
        assert order.index(automatic) < order.index(value)


@pytest.mark.parametrize(
    "keeps, remark",
    [
        ({cv2.CAP_PROP_EXPOSURE: 156.0}, "exposure (0.1 ms): 80 was asked, the device keeps 156"),
        ({cv2.CAP_PROP_AUTO_EXPOSURE: 3.0}, "automatic exposure (1: off): 1 was asked, the device keeps 3"),
        ({cv2.CAP_PROP_AUTO_WB: 1.0}, "automatic white balance (0: off): 0 was asked, the device keeps 1"),
        ({cv2.CAP_PROP_AUTOFOCUS: None}, "automatic focus (0: off): the device has no such control"),
    ],
)
def test_a_control_that_the_device_does_not_take_is_told_and_frames_come(started, keeps, remark):
    camera, frames = started(Device(keeps=keeps))
    assert camera.status.remarks == (remark,)
    assert wait(lambda: frames)


@pytest.mark.parametrize(
    "keeps, complaint",
    [
        ({cv2.CAP_PROP_FRAME_WIDTH: 1280.0}, "MJPG 640x480 was asked, the device gives MJPG 1280x480"),
        ({cv2.CAP_PROP_FOURCC: 0x56595559}, "MJPG 640x480 was asked, the device gives YUYV 640x480"),
        ({cv2.CAP_PROP_FPS: 30.0}, "60 Hz were asked of MJPG 640x480, the device gives 30: set camera_rate"),
    ],
)
def test_another_size_format_or_rate_is_refused_with_what_would_be_right(keeps, complaint):
    device = Device(keeps=keeps)
    with pytest.raises(OSError, match=complaint):
        UvcCamera(arm(60.0), UvcCameraSettings(), print, device.open)


def test_a_rate_that_the_device_cannot_tell_is_measured_alone(started):
    camera, frames = started(Device(keeps={cv2.CAP_PROP_FPS: None}))
    assert wait(lambda: len(frames) > 5) and not camera.status.fault


def test_a_device_that_is_unplugged_is_told_and_comes_back_by_itself_with_its_settings(started):
    device = Device()
    camera, frames = started(device)
    assert wait(lambda: len(frames) > 5)
    device.plugged = False
    assert wait(lambda: "unplugged" in camera.status.fault)
    assert "waiting for it" in camera.status.fault
    assert wait(lambda: "there is no such device" in camera.status.fault)
    before = len(frames)
    lost = frames[-1].lost
    device.plugged = True
    assert wait(lambda: len(frames) > before + 5)
    assert not camera.status.fault and camera.status.values["times plugged in again"] == "1"
    assert device.opened == 2 and frames[before].lost == lost, "what it missed while away is not known"


def test_a_device_that_is_unplugged_stays_away_where_the_settings_say_so(started):
    device = Device()
    camera, frames = started(device, reconnect=False)
    assert wait(lambda: frames)
    device.plugged = False
    assert wait(lambda: "reconnect is false: start the node anew" in camera.status.fault)
    device.plugged = True
    before = len(frames)
    time.sleep(0.7)  # longer than it would take to open it again
    assert len(frames) == before and device.opened == 1
    assert "unplugged" in camera.status.fault


def test_a_device_that_comes_back_as_another_is_not_taken(started):
    device = Device()
    camera, frames = started(device)
    assert wait(lambda: frames)
    device.plugged = False
    assert wait(lambda: camera.status.fault)
    device.keeps[cv2.CAP_PROP_FRAME_HEIGHT] = 720.0
    device.plugged = True
    assert wait(lambda: "the device gives MJPG 640x720" in camera.status.fault)
    before = len(frames)
    del device.keeps[cv2.CAP_PROP_FRAME_HEIGHT]
    assert wait(lambda: len(frames) > before)


FAULTS = {
    "black": "without contrast",
    "frozen": "repeated",
    "torn": "torn",
    "small": "of another size",
    "early": "stamped wrongly",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_device_whose_frames_turn_bad_falls_silent_with_the_reason_and_goes_on_when_they_are_good(
    started, fault
):
    bad = [False]
    camera, frames = started(Device(rate=100.0, faults=lambda number: fault if bad[0] else ""), rate=100.0)
    assert wait(lambda: len(frames) > 5)
    bad[0] = True
    assert wait(lambda: FAULTS[fault] in camera.status.fault)
    assert "no frame for" in camera.status.fault
    silent = len(frames)
    assert int(camera.status.values[f"frames refused, {FAULTS[fault]}"]) > 0
    bad[0] = False
    assert wait(lambda: len(frames) > silent + 3) and not camera.status.fault
    assert frames[-1].lost > 0


def test_frames_that_the_device_drops_are_counted(started):
    camera, frames = started(Device(rate=100.0, faults=lambda n: "drop" if n % 10 == 0 else ""), rate=100.0)
    assert wait(lambda: len(frames) > 45)
    camera.close()
    exposed = round((frames[-1].stamp_ns - frames[0].stamp_ns) * 1e-9 * 100.0) + 1
    assert exposed == len(frames) + frames[-1].lost and frames[-1].lost >= 4
    assert camera.status.values["frames lost"] == str(frames[-1].lost)


def test_a_device_without_stamps_has_those_of_arrival_and_says_so(started):
    camera, frames = started(Device(stamps="none"))
    assert wait(lambda: frames)
    assert camera.status.values["stamps"] == "arrival in this program"


def test_a_read_that_hangs_does_not_keep_the_driver_from_closing(started):
    device = Device(rate=60.0, faults=lambda number: "drop" if number > 5 else "")
    camera, frames = started(device)
    assert wait(lambda: len(frames) == 5)
    assert wait(lambda: "the device gives nothing" in camera.status.fault)
    start = time.monotonic()
    camera.close()
    assert time.monotonic() - start < 10.0
    device.faults = lambda number: ""
    time.sleep(0.1)
    assert len(frames) == 5, "no frame is reported after it is closed"


def test_a_device_that_cannot_be_opened_says_why(tmp_path, monkeypatch):
    with pytest.raises(OSError, match=r"/nowhere/video7: there is no such device; devices: "):
        open_v4l2("/nowhere/video7")
    recording = tmp_path / "video.avi"
    recording.write_bytes(b"")
    with pytest.raises(OSError, match=r"is no video device \(a recording is played by the driver 'replay'\)"):
        open_v4l2(str(recording))
    with pytest.raises(OSError, match=r"/dev/null: is in use by .*, or gives no images"):
        open_v4l2("/dev/null")
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(OSError, match="/dev/null: no permission; type: sudo usermod -aG video"):
        open_v4l2("/dev/null")


def test_wrong_settings_are_refused_with_what_would_be_right():
    with pytest.raises(SettingError, match="must be one of MJPG, YUYV, UYVY, GREY, NV12"):
        UvcCameraSettings(format="H264")
    with pytest.raises(SettingError, match=r"exposure = 8.0 s: must lie in \[0, 1\] s"):
        UvcCameraSettings(exposure=8.0)
