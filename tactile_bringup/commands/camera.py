"""Find the camera of a tactile sensor, look through it, check it, write it into a scene."""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tactile_base.yaml_file import Section, text_of
from tactile_bringup.camera_view import check, serve, watching
from tactile_bringup.commands.changes import (
    add_command,
    add_group,
    add_set_option,
    changed_settings,
    positive_int,
)
from tactile_bringup.scene_values import write_into
from tactile_bringup.staged_arm import arm_of
from tactile_drivers.uvc_camera import UvcCameraSettings
from tactile_drivers.video_devices import find_devices
from tactile_perception.datasets.check_plots import draw_inputs
from tactile_perception.datasets.suggestion import suggested
from tactile_scene.arm_settings import ArmLimits, SafetySettings
from tactile_scene.camera import CAMERAS
from tactile_scene.scene import EXTERNAL, SIM, ArmScene, SensorScene, SensorSettings
from tactile_scene.scene_file import load_scene

EXAMPLE = "exposure=0.005"
_LOOKS = 12  # images
#: Written into a scene even where they are the defaults: a picture must be the same tomorrow.
PINNED = ("format", "width", "height", "exposure", "white_balance")


def register(subparsers: Any) -> None:
    commands = add_group(subparsers, "camera", __doc__)
    add_command(commands, "list", run_list, help="devices and what they offer", status=1)
    show = add_command(commands, "show", run_show, help="a live picture, in a browser", status=1)
    _add_source(show)
    show.add_argument("--host", default="127.0.0.1", help="address that serves the page (127.0.0.1)")
    show.add_argument("--port", type=int, default=8080, help="and its port; 0: any (8080)")
    checked = add_command(commands, "check", run_check, help="rate, focus, number of markers", status=1)
    _add_source(checked)
    checked.add_argument("--markers", type=positive_int, metavar="N", help="how many the sensor has")
    checked.add_argument("--seconds", type=float, default=2.0, metavar="S", help="to look for (2)")
    checked.add_argument("--blur", type=float, default=2.0, metavar="PX", help="largest that is sharp (2)")
    inputs = add_command(commands, "inputs", run_inputs, help="how its images become a network's", status=1)
    _add_source(inputs)
    inputs.add_argument("--seconds", type=float, default=10.0, metavar="S", help="to press it in (10)")
    inputs.add_argument("--out", type=Path, default=Path("inputs.png"), help="a picture (inputs.png)")
    scene = add_command(commands, "scene", run_scene, help="the camera's part of a scene", status=1)
    _add_source(scene)
    scene.add_argument("--into", type=Path, metavar="FILE", help="scene file to write it into")


def _add_source(parser: Any) -> None:
    add = parser.add_argument
    add("device", nargs="?", help="path of the device (default: the only one)")
    add(
        "--driver",
        default="uvc",
        help="uvc, digit, gelsight_mini, replay, or a driver of another package (uvc)",
    )
    add("--rate", type=float, default=60.0, metavar="HZ", help="frames a second (60)")
    add("--scene", metavar="FILE", help="take driver, settings and rate from this scene")
    add("--arm", metavar="NAME", help="and of this arm (default: the only one with a camera driver)")
    add_set_option(parser, f"a setting of the driver, as {EXAMPLE}")


def run_list(arguments: argparse.Namespace) -> int:
    """List the video devices and what they offer."""
    devices = find_devices()
    if not devices:
        raise OSError("there is no video device: is the camera plugged in? `lsusb` lists what there is")
    for device in devices:
        print(f"{device.path}: {device.name}")
        if device.lasting != device.path:
            print(f"    lasting path: {device.lasting}")
        if device.fault:
            print(f"    {device.fault}")
        for form in device.formats:
            print(f"    {form}")
    return 0


def run_show(arguments: argparse.Namespace) -> int:
    """Serve a live picture with focus and markers, until Ctrl-C."""
    if not 0 <= arguments.port <= 65535:
        raise ValueError(f"--port {arguments.port}: must lie in [0, 65535]")
    with watching(chosen(arguments)) as watch:
        server = serve(watch, arguments.host, arguments.port)
        host, port = server.server_address[:2]
        print(f"live picture: http://{host!s}:{port}/ (Ctrl-C ends)", flush=True)
        try:
            server.serve_forever(poll_interval=0.1)
        except KeyboardInterrupt:
            return 0
        finally:
            server.server_close()
    return 0


def run_check(arguments: argparse.Namespace) -> int:
    """Measure rate, focus and number of markers; the exit code is 0 if all is right, else 1."""
    if not 0.1 <= arguments.seconds <= 600.0:
        raise ValueError(f"--seconds {arguments.seconds:g}: must lie in [0.1, 600] s")
    arm = chosen(arguments)
    assert arm.sensor is not None
    rate = arm.sensor.settings.camera_rate
    with watching(arm) as watch:
        verdicts = check(watch, rate, arguments.seconds, arguments.markers, arguments.blur)
        for verdict in verdicts:
            print(f"{'ok    ' if verdict.good else 'WRONG '} {verdict.text}")
        status = watch.status
    for remark in status.remarks:
        print(f"told   {remark}")
    for name, value in status.values.items():
        print(f"       {name}: {value}")
    return 0 if all(verdict.good for verdict in verdicts) else 1


def run_inputs(arguments: argparse.Namespace) -> int:
    """Look at images without and in contact, and propose their pre-processing: a picture and a file.

    The first image is taken as one without contact. The file is for `tactile data collect --config`.
    """
    if not 1.0 <= arguments.seconds <= 600.0:
        raise ValueError(f"--seconds {arguments.seconds:g}: must lie in [1, 600] s")
    with watching(chosen(arguments)) as watch:
        images = [watch.next(2.0).copy()]
        print(f"press and shear the sensor now, in all ways, for {arguments.seconds:g} s", flush=True)
        for _ in range(_LOOKS):
            time.sleep(arguments.seconds / _LOOKS)
            images.append(watch.next(2.0).copy())
    suggestion = suggested(images, reference=True)
    settings, path = suggestion.settings, arguments.out.with_suffix(".yaml")
    print("\n".join([*suggestion.reasons, f"a network sees: {settings.steps}"]))
    draw_inputs(images, settings, arguments.out, images[0])
    path.write_text(yaml.safe_dump({"preprocessing": yaml.safe_load(text_of(settings))}, sort_keys=False))
    print(f"{arguments.out}: does it show the skin, and little else? Then collect with --config {path}")
    return 0


def run_scene(arguments: argparse.Namespace) -> int:
    """Print the camera's part of a scene, or write it into one; the camera has to work for it."""
    arm = chosen(arguments)
    assert arm.sensor is not None
    with watching(arm) as watch:
        watch.next(2.0)
    kind = CAMERAS.load(arm.sensor.camera).settings_class
    given = arm.sensor.camera_settings.values
    settings = asdict(kind.from_mapping(given))
    values = {
        "camera": arm.sensor.camera,
        "camera_settings": {n: v for n, v in settings.items() if n in given or n in PINNED},
        "camera_rate": arm.sensor.settings.camera_rate,
    }
    if arguments.into is None:
        print(yaml.safe_dump({"sensor": values}, sort_keys=False, width=100), end="")
        return 0
    write_into(arguments.into, arguments.arm, values)
    print(f"{arguments.into}: written")
    return 0


def chosen(arguments: argparse.Namespace) -> ArmScene:
    """An arm whose sensor has the camera that is meant.

    Raises `ValueError` or `OSError` with what would be right.
    """
    if arguments.scene is not None:
        return _of_scene(arguments)
    settings = changed_settings(arguments.changes, EXAMPLE)
    kind = CAMERAS.load(arguments.driver).settings_class
    if arguments.device is not None and issubclass(kind, UvcCameraSettings):
        settings["device"] = arguments.device
    elif arguments.driver == "uvc" and "device" not in settings:
        settings["device"] = _only_device()
    elif arguments.device is not None:
        raise ValueError(f"{arguments.device}: the driver '{arguments.driver}' has its settings by --set")
    kind.from_mapping(settings, "--set")
    none = Section(Path("--set"), 1, {}, {})
    sensor = SensorScene(
        SensorSettings(camera_rate=arguments.rate),
        np.eye(4),
        arguments.driver,
        Section(Path("--set"), 1, settings, {}),
    )
    return ArmScene(
        "arm", EXTERNAL, none, np.eye(4), np.eye(4), ArmLimits(), SafetySettings(), (), sensor
    )  # fmt: skip


def _of_scene(arguments: argparse.Namespace) -> ArmScene:

    if arguments.device is not None or arguments.changes:
        raise ValueError("--scene says which camera and how: leave out the device and --set")

    def driven(arm: ArmScene) -> bool:
        return arm.sensor is not None and arm.sensor.camera not in (SIM, EXTERNAL)

    return arm_of(load_scene(arguments.scene), arguments.arm, driven, "an arm with a camera driver")


def _only_device() -> str:

    devices = find_devices()
    if len(devices) == 1:
        return str(devices[0].lasting)
    there = ", ".join(str(device.path) for device in devices) or "none"
    raise OSError(f"name the device; there are: {there} (`tactile camera list`)")
