"""A video or a folder in place of a camera: order, rate, stamps, the end."""

import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tactile_drivers.replay_camera import ReplayCamera, ReplayCameraSettings
from tactile_scene.camera import CAMERAS, open_camera
from tactile_scene.scene import SensorSettings
from tactile_scene.scene_file import load_scene

pytestmark = pytest.mark.live

PATIENCE = 20.0  # s


def played(folder: Path, path: str, loop: bool, rate: float = 100.0, count: int = 7):
    """The driver after it has reported so many frames, or has ended; and the frames."""
    section = SimpleNamespace(path=folder / "scene.yaml")
    sensor = SimpleNamespace(settings=SensorSettings(camera_rate=rate), camera_settings=section)
    frames: list = []
    camera = ReplayCamera(
        SimpleNamespace(sensor=sensor), ReplayCameraSettings(path=path, loop=loop), frames.append
    )
    end = time.monotonic() + PATIENCE
    while len(frames) < count and not camera.status.fault and time.monotonic() < end:
        time.sleep(0.002)
    camera.close()
    return camera, frames


def gray(number: int) -> np.ndarray:
    return np.full((48, 64), 20 * number, np.uint8)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "images").mkdir()
    for number in (1, 2, 10):  # which a plain sort would begin with 1, 10
        cv2.imwrite(str(tmp_path / "images" / f"image_{number}.png"), gray(number))
    (tmp_path / "images" / "notes.txt").write_text("none")
    (tmp_path / "images" / "image_3.png").write_bytes(b"damaged")
    return tmp_path


def test_the_driver_has_the_name_replay():
    assert CAMERAS.load("replay") is ReplayCamera


def test_a_folder_is_played_in_the_order_of_its_numbers_at_the_rate_and_again(folder):
    before_ns = time.time_ns()
    camera, frames = played(folder, "images", loop=True)
    assert [int(frame.image[0, 0]) // 20 for frame in frames[:7]] == [1, 2, 10, 1, 2, 10, 1]
    stamps = [frame.stamp_ns for frame in frames]
    assert before_ns < stamps[0] and stamps[-1] <= time.time_ns()
    took = (stamps[-1] - stamps[0]) * 1e-9 * 100.0  # in periods: none came early, as what was lost says
    assert took >= 5.5 + frames[-1].lost - frames[0].lost
    assert not camera.status.fault


def test_once_it_ends_and_says_so(folder):
    camera, frames = played(folder, "images", loop=False)
    assert len(frames) == 3
    assert camera.status.fault == f"{folder / 'images'}: ended after 3 frames"


def test_a_video_is_played_gray(tmp_path):
    writer = cv2.VideoWriter(str(tmp_path / "touch.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30, (64, 48))
    for number in (2, 5, 9):
        writer.write(cv2.cvtColor(gray(number), cv2.COLOR_GRAY2BGR))
    writer.release()
    camera, frames = played(tmp_path, "touch.avi", loop=False)
    assert [round(float(frame.image.mean()) / 20) for frame in frames] == [2, 5, 9]
    assert frames[0].image.shape == (48, 64)
    assert camera.status.values["frames shown"] == "3"


@pytest.mark.parametrize("path", ["nowhere", "empty", "text.avi"])
def test_what_is_no_recording_is_refused_by_name(tmp_path, path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.avi").write_text("no video")
    with pytest.raises(OSError, match=f"{path}: is no video that can be read, and no folder of images"):
        played(tmp_path, path, loop=True)


def test_frames_are_reported_with_the_time_offset_of_the_scene(folder):
    (folder / "scene.yaml").write_text(
        "arms:\n  arm:\n    driver: external\n    start: {position: [0, 0, 0.1]}\n"
        "    sensor: {camera: replay, camera_settings: {path: images}, time_offset: -0.4}\n"
    )
    frames: list = []
    before_ns = time.time_ns()
    camera = open_camera(load_scene(folder / "scene.yaml").arms["arm"], frames.append)
    end = time.monotonic() + PATIENCE
    while not frames and time.monotonic() < end:
        time.sleep(0.002)
    camera.close()
    age = (time.time_ns() - frames[0].stamp_ns) * 1e-9
    assert 0.4 <= age <= 0.4 + (time.time_ns() - before_ns) * 1e-9
