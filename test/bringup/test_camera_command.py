"""`tactile camera`: devices, the live page, the check, the scene's section; each fault a sentence."""

import json
import re
import threading
import urllib.error
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from other_package.double_camera import Device, picture

from tactile_base.config_paths import config_path
from tactile_bringup.camera_view import serve, watching
from tactile_bringup.cli import main
from tactile_bringup.commands import camera as command
from tactile_bringup.scene_values import write_into
from tactile_drivers import uvc_camera, video_devices
from tactile_scene.scene_file import load_scene

pytestmark = pytest.mark.live

MARKERS = 14 * 10  # of the double's picture


@pytest.fixture
def device(monkeypatch):
    """A camera that `tactile camera` finds and opens."""
    device = Device(rate=60.0)
    monkeypatch.setattr(uvc_camera.UvcCamera.__init__, "__defaults__", (device.open,))
    found = video_devices.VideoDevice(
        Path("/dev/video0"),
        "HD USB Camera",
        Path("/dev/v4l/by-id/usb-HD"),
        (video_devices.VideoFormat("MJPG", 640, 480, (60.0, 30.0)),),
    )
    monkeypatch.setattr(command, "find_devices", lambda: [found])
    return device


@pytest.fixture
def scene(tmp_path):
    """The ramp's scene, whose arm somebody else drives."""
    text = config_path("scenes/ramp.yaml").read_text().replace("driver: sim", "driver: external")
    (tmp_path / "my_cell.yaml").write_text(text)
    return tmp_path / "my_cell.yaml"


def test_devices_are_listed_with_what_they_offer(device, capsys):
    assert main(["camera", "list"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "/dev/video0: HD USB Camera",
        "    lasting path: /dev/v4l/by-id/usb-HD",
        "    MJPG 640x480 at 60/30 Hz",
    ]


def test_a_camera_that_is_as_it_should_be_passes(device, capsys):
    assert (
        main(["camera", "check", "--markers", str(MARKERS), "--seconds", "0.5", "--set", "exposure=0.01"])
        == 0
    )
    text = capsys.readouterr().out
    assert text.count("ok     ") == 3 and f"{MARKERS} markers in" in text
    assert "stamps: kernel, CLOCK_MONOTONIC" in text


def test_wrong_markers_a_wrong_rate_and_blur_are_told_and_the_check_fails(device, capsys, monkeypatch):
    device.keeps = {cv2.CAP_PROP_FPS: None}
    device.rate = 20.0
    arguments = ["camera", "check", "--markers", "331", "--blur", "0.1", "--seconds", "0.5"]
    assert main(arguments) == 1
    text = capsys.readouterr().out
    assert text.count("WRONG  ") == 3
    assert "frames a second, 60 asked" in text and "must be 331" in text and "must be at most 0.1" in text


def test_the_page_shows_pictures_with_rings_on_the_markers_and_figures(device):
    arguments = command_arguments("show")
    with watching(command.chosen(arguments)) as watch:
        server = serve(watch, "127.0.0.1", 0)
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            url = f"http://127.0.0.1:{server.server_address[1]}"
            page = urllib.request.urlopen(url, timeout=20).read().decode()
            assert '<img src="/stream"' in page
            figures = json.loads(urllib.request.urlopen(f"{url}/figures", timeout=20).read())
            assert figures["markers"] == str(MARKERS) and figures["size"] == "640x480"
            assert "px, sharp below 2" in figures["blur of their edges"] and "fault" not in figures
            with urllib.request.urlopen(f"{url}/stream", timeout=20) as stream:
                for _ in range(2):
                    shown = read_part(stream)
                    assert shown.shape == (480, 640, 3)
                    green = (shown[:, :, 1].astype(int) - shown[:, :, 2]) > 60
                    assert green.sum() > 10 * MARKERS
            device.plugged = False
            fault = ""
            while "unplugged" not in fault:
                fault = json.loads(urllib.request.urlopen(f"{url}/figures", timeout=20).read()).get(
                    "fault", ""
                )
            with pytest.raises(urllib.error.HTTPError, match="404"):
                urllib.request.urlopen(f"{url}/other", timeout=20)
        finally:
            server.shutdown()
            thread.join()
            server.server_close()


def read_part(stream) -> np.ndarray:
    """The next picture of a multipart stream."""
    length = 0
    while (line := stream.readline()) != b"\r\n" or not length:
        if line.lower().startswith(b"content-length:"):
            length = int(line.split(b":")[1])
    return cv2.imdecode(np.frombuffer(stream.read(length), np.uint8), cv2.IMREAD_COLOR)


def command_arguments(*words: str):
    from tactile_bringup.cli import command_line

    return command_line().parse_args(["camera", *words])


def test_a_port_that_is_taken_is_named(device):
    with watching(command.chosen(command_arguments("show"))) as watch:
        server = serve(watch, "127.0.0.1", 0)
        with pytest.raises(OSError, match="Address already in use; --port names another port"):
            serve(watch, "127.0.0.1", server.server_address[1])
        server.server_close()


def test_the_section_is_printed_with_what_makes_tomorrows_pictures_the_same(device, capsys):
    assert main(["camera", "scene", "--rate", "60", "--set", "exposure=0.004"]) == 0
    assert yaml.safe_load(capsys.readouterr().out) == {
        "sensor": {
            "camera": "uvc",
            "camera_settings": {
                "device": "/dev/v4l/by-id/usb-HD",
                "format": "MJPG",
                "width": 640,
                "height": 480,
                "exposure": 0.004,
                "white_balance": 4600.0,
            },
            "camera_rate": 60.0,
        }
    }


def test_the_section_is_written_into_a_scene_which_can_be_checked_by_its_name(device, scene, capsys):
    comments = [line for line in scene.read_text().splitlines() if "#" in line]
    assert main(["camera", "scene", "--into", str(scene), "--set", "exposure=0.004"]) == 0
    sensor = load_scene(scene).arms["arm"].sensor
    assert sensor.camera == "uvc" and sensor.settings.camera_rate == 60.0
    assert sensor.camera_settings.values["exposure"] == 0.004
    assert [line for line in scene.read_text().splitlines() if "#" in line] == comments
    assert [path.name for path in scene.parent.iterdir()] == [scene.name]
    assert main(["camera", "check", "--scene", str(scene), "--seconds", "0.3"]) == 0


def test_a_recording_is_looked_at_like_a_camera(tmp_path, capsys, monkeypatch):
    (tmp_path / "frames").mkdir()
    for number in range(3):
        cv2.imwrite(str(tmp_path / "frames" / f"{number}.png"), picture(number))
    monkeypatch.chdir(tmp_path)
    arguments = ["--driver", "replay", "--set", "path=frames", "--rate", "40", "--seconds", "0.5"]
    main(["camera", "check", *arguments, "--markers", str(MARKERS)])
    text = capsys.readouterr().out  # whether the rate is held is this machine's affair
    assert f"ok     {MARKERS} markers in" in text and "ok     edges blurred" in text


WRONG = {
    "two devices": (["check"], "name the device; there are: /dev/video0, /dev/video1"),
    "no device": (["check", "/dev/video7"], "/dev/video7: there is no such device; devices:"),
    "unknown setting": (["show", "--set", "exposre=1"], "did you mean 'exposure'?"),
    "setting out of range": (["check", "--set", "exposure=8.0"], "exposure = 8.0 s: must lie in [0, 1] s"),
    "rate out of range": (["check", "/dev/video0", "--rate", "1000"], "must lie in [1, 240] Hz"),
    "unknown driver": (["check", "--driver", "usb"], "unknown name 'usb'"),
    "scene and device": (["check", "/dev/video0", "--scene", "ramp"], "leave out the device and --set"),
    "scene without a driver": (["check", "--scene", "ramp"], "there are: none"),
    "port": (["show", "--port", "70000"], "--port 70000: must lie in [0, 65535]"),
    "seconds": (["check", "--seconds", "inf"], "--seconds inf: must lie in [0.1, 600] s"),
}


@pytest.mark.parametrize("words, complaint", WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_a_sentence(words, complaint, capsys, monkeypatch):
    two = [video_devices.VideoDevice(Path(f"/dev/video{n}"), "", Path(f"/dev/video{n}")) for n in range(2)]
    monkeypatch.setattr(command, "find_devices", lambda: two)
    if "/dev/video0" not in words and words != ["check"] and "/dev/video7" not in words:
        monkeypatch.setattr(command, "find_devices", lambda: two[:1])
    assert main(["camera", *words]) == 1
    text = " ".join(capsys.readouterr().err.split())
    assert complaint in text and "Traceback" not in text


def test_no_camera_at_all_is_a_sentence(capsys, monkeypatch):
    monkeypatch.setattr(command, "find_devices", list)
    assert main(["camera", "list"]) == 1
    assert "there is no video device: is the camera plugged in?" in capsys.readouterr().err


@pytest.mark.parametrize(
    "fault, complaint",
    [
        ({"busy": True}, "/dev/v4l/by-id/usb-HD: is in use by another program"),
        (
            {"keeps": {cv2.CAP_PROP_FRAME_WIDTH: 1280.0}},
            "the device gives MJPG 1280x480; `tactile camera list`",
        ),
        ({"faults": lambda number: "black"}, "without contrast: gray levels of 0"),
        ({"faults": lambda number: "drop"}, "the device gives nothing"),
    ],
    ids=["busy", "size", "black", "silent"],
)
def test_a_camera_that_cannot_be_used_is_a_sentence_and_no_scene_is_written(
    device, scene, capsys, fault, complaint
):
    for name, value in fault.items():
        setattr(device, name, value)
    before = scene.read_text()
    assert main(["camera", "scene", "--into", str(scene)]) == 1
    assert complaint in " ".join(capsys.readouterr().err.split())
    assert scene.read_text() == before


def test_a_scene_that_cannot_be_written_to_stays_as_it_was(device, scene, capsys):
    before = scene.read_text()
    assert main(["camera", "scene", "--into", str(scene), "--arm", "left"]) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "--arm must name an arm; unknown name 'left'; valid: arm" in said
    assert main(["camera", "scene", "--into", str(scene.parent / "other.yaml")]) == 1
    assert "other.yaml" in capsys.readouterr().err
    assert scene.read_text() == before


def test_the_section_in_the_docs_is_what_the_command_prints_and_what_a_scene_may_have(device, scene, capsys):
    page = (Path(__file__).parents[2] / "docs" / "own_camera.md").read_text()
    words = re.search(r"^ +tactile (camera scene .*)$", page, re.M)[1].split()
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert f"```yaml\n{printed}```" in page
    write_into(scene, "arm", yaml.safe_load(printed)["sensor"])
    given = load_scene(scene).arms["arm"].sensor.camera_settings
    assert given.checked(uvc_camera.UvcCameraSettings, given.values).exposure == 0.004
