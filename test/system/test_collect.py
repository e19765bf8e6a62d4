"""`tactile data collect` in the simulation, with real nodes: killed midway it goes on, nothing is lost."""

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tactile_base.config_paths import config_path
from tactile_base.settings import SettingError
from tactile_bringup.commands.data_collect import EDGED, chosen_settings, chosen_surface, defaults, frame_on
from tactile_bringup.launching.environment import free_domain_id
from tactile_perception.datasets.dataset import read_dataset
from tactile_records.collecting.settings import DataCollectionSettings
from tactile_scene.sampling import SamplingSettings, pose_of
from tactile_scene.scene_file import load_scene

SAMPLES = 2
QUICK = ["motion.air_speed=0.1", "motion.contact_speed=0.04", "motion.settle_time=0.05"]


def command(out: Path, *options: str) -> list[str]:
    changes = [word for change in QUICK for word in ("--set", change)]
    start = [sys.executable, "-m", "tactile_bringup.cli", "data", "collect", str(out), "--headless"]
    return [*start, "--seed", "9", "--logs", str(out.parent / "runs"), *changes, *options]


def rows(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.ros
@pytest.mark.slow
def test_a_killed_collection_goes_on_and_nothing_is_lost_or_there_twice(tmp_path):
    pytest.importorskip("rclpy", reason="needs ROS 2")
    variables = {**os.environ, "ROS_DOMAIN_ID": str(free_domain_id())}  # both in one, as on a robot
    out = tmp_path / "data"
    journal = out / "targets_images.partial.csv"
    collect = command(out, "--samples", str(SAMPLES))
    with subprocess.Popen(collect, env=variables, stdout=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 90.0  # beside a suite that starts, nodes take their time
        while not (first := rows(journal)) and time.monotonic() < deadline:
            time.sleep(0.05)
        os.kill(process.pid, signal.SIGKILL)
    assert first, "no sample within 90 s"
    image = (out / "processed_images" / "image_1.png").read_bytes()
    deadline, again = time.monotonic() + 20.0, None
    while time.monotonic() < deadline:  # the killed command's nodes take a moment to end
        again = subprocess.run(collect, env=variables, capture_output=True, text=True, timeout=60.0)
        if "another process" not in again.stderr:
            break
        time.sleep(0.3)
    assert again.returncode == 0, again.stdout + again.stderr
    data = read_dataset(out)
    assert data.names == [f"image_{number}.png" for number in range(1, SAMPLES + 1)]
    assert data.report.problems == {} and data.report.notes == []
    assert rows(out / "targets_images.csv")[: len(first)] == first
    assert (out / "processed_images" / "image_1.png").read_bytes() == image
    for k, euler in enumerate(data.euler_mm_deg):
        asked = pose_of(SamplingSettings(), 9, k) * ([1e3] * 3 + [180 / np.pi] * 3)
        np.testing.assert_allclose(euler, asked, atol=0.12)


@pytest.mark.parametrize(
    "options, message",
    [
        (["--scene", "dome"], "data are collected on one flat surface"),
        (["--images", "none"], "must be one of processed, raw, both"),
        (["--arm", "left"], "--arm must name an arm"),
        (["--surface", "tabel"], "did you mean 'table'"),
        (["--set", "motion.gian=3"], "did you mean 'gain'"),
        (["--set", "moton.gain=3"], "did you mean 'motion'"),
        (["--touch", "2"], "two touches do not tell a plane"),
    ],
)
def test_what_cannot_be_collected_is_refused_before_anything_starts(tmp_path, capsys, options, message):
    from tactile_bringup.cli import main

    assert main(["data", "collect", str(tmp_path / "data"), *options]) == 2
    assert message in capsys.readouterr().err


def test_other_ranges_do_not_mix_into_a_folder(tmp_path, capsys):
    from tactile_bringup.commands.data import register
    from tactile_bringup.commands.data_collect import make_plan

    def plan(*options: str):
        import argparse

        parser = argparse.ArgumentParser(prog="tactile")
        register(parser.add_subparsers())
        return make_plan(parser.parse_args(["data", "collect", str(tmp_path / "data"), *options]))

    first = plan("--samples", "10")
    assert first.missing == 10 and first.graph.plans[0].goals[0].goal.samples == 10
    assert plan("--samples", "20").missing == 20
    with pytest.raises(ValueError, match="made with another sampling"):
        plan("--set", "sampling.depth=[0.001, 0.002]")
    with pytest.raises(ValueError, match="made with another first"):
        plan("--validation")


def test_an_edge_is_pressed_deeper_and_less_tilted_unless_told_otherwise():
    scene = load_scene(Path(__file__).parents[2] / "examples/my_sensor/my_plate.yaml")
    arm = scene.arms["arm"]
    T = frame_on(scene, chosen_surface(scene, arm, None, EDGED), arm)
    np.testing.assert_allclose(T[:3, 3], [0.45, 0.0, arm.sensor.settings.tip_radius], atol=1e-9)
    np.testing.assert_allclose(T[:3, 1:3].T, [[0, 1, 0], [0, 0, -1]], atol=1e-9)  # to the plate, into it
    settings = chosen_settings(defaults(arm, 3, edge=True), None, ["sampling.depth=[0.004, 0.005]"])
    assert settings.edge.pressed and settings.edge.tip_radius == arm.sensor.settings.tip_radius
    assert settings.sampling.depth == (0.004, 0.005) and settings.sampling.disk_radius == 3e-3


def test_with_an_external_arm_only_the_stage_before_it_is_started(tmp_path):
    import argparse

    from tactile_bringup.commands.data_collect import make_plan, register

    scene = tmp_path / "external.yaml"
    text = config_path("scenes/plane.yaml").read_text()
    scene.write_text(text.replace("driver: sim", "driver: external"))
    parser = argparse.ArgumentParser(prog="tactile")
    register(parser.add_subparsers())
    graph = make_plan(parser.parse_args(["collect", str(tmp_path / "data"), "--scene", str(scene)])).graph
    assert [n.full_name for n in graph.nodes] == ["/arm/arm", "/arm/controller"]


def test_the_contact_frame_of_a_scene_lies_under_the_start_a_radius_off_the_table():
    scene = load_scene("plane")
    arm = scene.arms["arm"]
    T = frame_on(scene, chosen_surface(scene, arm, None), arm)
    np.testing.assert_allclose(T[:2, 3], arm.T_base_start[:2, 3], atol=1e-12)
    assert T[2, 3] == pytest.approx(arm.sensor.settings.tip_radius)
    np.testing.assert_allclose(T[:3, 2], [0, 0, -1], atol=1e-12)


def test_settings_come_from_a_file_and_from_the_command_line_on_top(tmp_path):
    file = tmp_path / "collect.yaml"
    file.write_text("motion: {gain: 5.0, clearance: 0.004}\ntouch: {speed: 1e-3}\n")
    first = DataCollectionSettings().replaced(touch__points=3)
    settings = chosen_settings(first, file, ["motion.gain=6.0"])
    assert settings.motion.gain == 6.0 and settings.motion.clearance == 0.004
    assert settings.touch.points == 3 and settings.touch.speed == 1e-3
    file.write_text("motion: {gian: 5.0}\n")
    with pytest.raises(SettingError, match=r"collect\.yaml:1: motion: .*did you mean 'gain'"):
        chosen_settings(first, file, [])
