"""Rehearsals: real drivers against the doubles of their controllers, all nodes, a simulated sensor."""

import os
import re
import sys
from pathlib import Path

import pytest
from launched import Launched
from other_package import installed
from real_arm import real_time

from tactile_base.config_paths import config_path
from tactile_base.settings import SettingError
from tactile_doubles.rehearsal import rehearsed
from tactile_perception.datasets.dataset import read_dataset
from tactile_records.runs.from_bag import read_arms
from tactile_records.runs.metrics import report
from tactile_scene.scene_file import load_scene

PATH = 0.03  # m
TASK = f"""
roles:
  follower:
    task: surface_following
    controller: surface_following_tuned
    settings:
      watchdog: {{patience: 30.0, start_timeout: 60.0}}
      contact: {{approach_timeout: 100.0, settle_timeout: 100.0}}
scenes:
  my_cell:
    follower:
      goals: [{{name: across, direction_deg: 90.0, length: {PATH}}}]
"""
IDEAL = "simulation: {rate: 60, sensors: {arm: {fidelity: ideal}}}\n"


NEEDS = {"ur": ("rtde_control",), "franka": ("franky", "franky_sim")}


def cell(folder: Path, driver: str, more: str = "") -> Path:
    """The example scene at 30 exposures a second, as a user would copy it."""
    text = config_path(f"scenes/{driver}_example.yaml").read_text()
    path = folder / "my_cell.yaml"
    path.write_text(text.replace("camera_rate: 60", "camera_rate: 30") + more)
    return path


@pytest.fixture
def launched(tmp_path, driver):
    pytest.importorskip("rclpy", reason="needs ROS 2")
    for module in NEEDS[driver]:
        pytest.importorskip(module, reason=f"{module} has no wheel for this Python or machine")
    if driver == "franka" and not real_time():
        pytest.skip("needs real-time priorities: a thread that is late makes the motions rough")
    launches = []

    def start(*words: str) -> Launched:
        launches.append(Launched(tmp_path, [sys.executable, "-m", "tactile_bringup.cli", *words]))
        return launches[-1]

    yield start
    for launch in launches:
        launch.kill()


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.parametrize("driver", list(NEEDS))
def test_a_surface_is_followed_through_the_driver_of_a_real_arm_and_has_the_same_report(
    launched, tmp_path, driver
):
    (tmp_path / "task.yaml").write_text(TASK)
    scene, bag = cell(tmp_path, driver, IDEAL), tmp_path / "bag"
    launch = launched(
        "launch", str(tmp_path / "task.yaml"), "--scene", str(scene), "--rehearse", "--headless",
        "--out", str(tmp_path / "runs"), "--record", str(bag),
    )  # fmt: skip
    assert launch.end() == 0, launch.output
    assert re.search(r"across: done \(3\d mm", launch.output), launch.output
    values = report(read_arms(bag)["arm"])
    assert values["succeeded"]
    assert values["contact_fraction"] == 1.0
    assert values["depth_rms_mm"] <= 0.5
    assert values["path_length_mm"] == pytest.approx(1e3 * PATH, abs=2.0)


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.parametrize("driver", list(NEEDS))
def test_the_check_of_an_arm_passes_on_its_double_and_it_ends_where_it_began(launched, tmp_path, driver):
    check = launched("arm", "check", "--scene", str(cell(tmp_path, driver)), "--rehearse", "--move")
    assert check.end() == 0, check.output
    said = " ".join(check.output.split())
    for what in ("direction", "round trip", "reset", "computer hangs"):
        assert f"ok {what}: " in said, said
    assert "commands end: at rest after" in said or "while it runs (" in said, said  # an alarm that says why
    for what in ("stop", "emergency stop"):  # a computer that is held up meanwhile makes it one to look at
        assert re.search(f"(ok|look) {what}: at rest after ", said), said
    assert "agrees with the scene in" in said


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.parametrize("driver", ["ur", pytest.param("franka", marks=pytest.mark.asked)])
def test_data_are_collected_through_the_driver_of_a_real_arm(launched, tmp_path, driver):
    out = tmp_path / "data"
    launch = launched(
        "data", "collect", str(out), "--scene", str(cell(tmp_path, driver)), "--rehearse", "--headless",
        "--samples", "2", "--seed", "9", "--logs", str(tmp_path / "runs"),
        "--set", "motion.air_speed=0.05", "--set", "motion.contact_speed=0.04",
        "--set", "motion.settle_time=0.05",
    )  # fmt: skip
    assert launch.end() == 0, launch.output
    assert len(read_dataset(out).labels) == 2


@pytest.mark.ros
@pytest.mark.slow
def test_a_driver_of_ones_own_is_rehearsed_in_contact_where_it_says_that_its_arm_is(tmp_path):
    (tmp_path / "site").mkdir()
    folders = [*installed(tmp_path / "site"), *filter(None, [os.environ.get("PYTHONPATH")])]
    text = config_path("scenes/ur_example.yaml").read_text().replace("driver: ur", "driver: bench_arm")
    text = re.sub(r"driver_settings:\n(      .*\n)+", "driver_settings: {}\n", text)
    text = text.replace("kinematics: {description: ur5e}", "")
    text = text.replace("camera_rate: 60", "camera_rate: 30")
    (tmp_path / "my_cell.yaml").write_text(text + IDEAL)
    (tmp_path / "task.yaml").write_text(TASK)
    bag = tmp_path / "bag"
    command = [sys.executable, "-m", "tactile_bringup.cli", "launch", str(tmp_path / "task.yaml")]
    command += ["--scene", str(tmp_path / "my_cell.yaml"), "--rehearse", "--headless"]
    command += ["--out", str(tmp_path / "runs"), "--record", str(bag)]
    launch = Launched(tmp_path, command, PYTHONPATH=":".join(folders))
    try:
        assert launch.end() == 0, launch.output
        values = report(read_arms(bag)["arm"])
        assert values["succeeded"] and values["contact_fraction"] == 1.0 and values["depth_rms_mm"] <= 0.5
    finally:
        launch.kill()


def test_an_arm_without_a_double_cannot_be_rehearsed(tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_text("arms:\n  arm:\n    driver: external\n    start: {position: [0, 0, 0.1]}\n")
    with pytest.raises(
        SettingError, match="there is none for the driver 'external' of 'arm', but for franka, ur"
    ):
        rehearsed(load_scene(path))


def test_a_camera_rate_that_the_simulation_does_not_have_is_refused_in_a_rehearsal(tmp_path):
    path = cell(tmp_path, "ur")
    path.write_text(path.read_text().replace("camera_rate: 30", "camera_rate: 50"))
    with pytest.raises(SettingError, match=r"camera_rate = 50 Hz: .* 120 Hz, must be a mult"):
        rehearsed(load_scene(path))


def test_a_correction_of_the_real_cameras_stamps_is_none_of_the_simulated_one(tmp_path):
    path = cell(tmp_path, "ur")
    path.write_text(path.read_text().replace("camera_rate: 30", "camera_rate: 30\n      time_offset: 0.012"))
    scene = load_scene(path)
    assert scene.arms["arm"].sensor.settings.time_offset == 0.012
    assert rehearsed(scene).arms["arm"].sensor.settings.time_offset == 0.0
