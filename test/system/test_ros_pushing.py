"""Two arms push an object over real DDS, a short way: the bag tells of it, the loop without ROS agrees."""

import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from launched import Launched

from tactile_base.config_paths import config_folder
from tactile_bringup.cli import main
from tactile_bringup.offline import run_arms_offline
from tactile_control.task_file import load_task
from tactile_drivers.scene import load_scene
from tactile_records.runs.from_bag import read_arms
from tactile_records.runs.pushing import body_poses, numbers

pytest.importorskip("rclpy", reason="needs ROS 2")
pytestmark = [pytest.mark.ros, pytest.mark.slow]

# a machine that holds up a process only delays the task
PATIENT = "watchdog: {patience: 30.0, start_timeout: 60.0}"
CONTACT = "contact: {approach_timeout: 100.0, settle_timeout: 100.0}"
TARGET = "target: [0.115, -0.115, 0.045]"  # some 115 mm of pushing, the first of them with target alignment


@pytest.fixture(scope="module")
def configuration(tmp_path_factory) -> Path:
    """The shipped configuration with a target near by, and sensors without images."""
    folder = tmp_path_factory.mktemp("configuration") / "config"
    shutil.copytree(config_folder(), folder)
    task, scene = folder / "tasks" / "dual_pushing.yaml", folder / "scenes" / "dual_pushing.yaml"
    text, changed = re.subn(r"target: \[0\.375, 0\.0, 0\.045\]", TARGET, task.read_text())
    assert changed == 1
    for name in ("pushing", "object_tracking"):
        wanted = f"    task: {name}\n"
        assert text.count(wanted) == 1
        text = text.replace(wanted, f"{wanted}    settings: {{{PATIENT}, {CONTACT}}}\n")
    text, changed = re.subn(r"alignment: \{ki: 0.5\}", r"\g<0>, task: {speed: 0.02}", text)
    assert changed == 1
    task.write_text(text)
    text, changed = re.subn(r"( +)image: \{skin:", r"\1fidelity: ideal\n\1image: {skin:", scene.read_text())
    assert changed == 2
    scene.write_text(text)
    return folder


@pytest.fixture(scope="module")
def finished(tmp_path_factory, configuration):
    """One run to its end: the launch and the records of both arms."""
    folder = tmp_path_factory.mktemp("finished")
    command = [sys.executable, "-m", "tactile_bringup.cli", "launch", "dual_pushing", "--headless"]
    launch = Launched(
        folder,
        [*command, "--out", str(folder), "--record", str(folder / "bag")],
        TACTILE_CONFIG_DIR=str(configuration),
    )
    try:
        launch.wait_for("push leader: push")
        launch.end()
    finally:
        launch.kill()
    return launch, read_arms(folder / "bag")


def test_the_push_ends_well_and_nothing_is_left(finished):
    launch, run = finished
    assert launch.process.returncode == 0, launch.output
    assert "leader: [1/1] push: done" in launch.output
    assert launch.leaves_nothing(), launch.left()
    assert all(record.result["succeeded"] for record in run.values())


def test_the_bag_tells_of_contact_body_and_target(finished):
    _, run = finished
    values = numbers(run["leader"], run)
    push = values["push"]
    assert values["contact_fraction"] == 1.0 and push["follower_contact_fraction"] == 1.0
    assert push["distance_mm"] < 20.5
    assert push["follower"] == "follower" and push["toppled"] is False
    assert 60.0 < push["body_way_mm"] < 120.0
    assert abs(push["error_mm"] - push["error_believed_mm"]) < 2.0


def test_the_loop_without_ros_pushes_the_body_to_the_same_place(finished, configuration):
    _, run = finished
    scene = load_scene(configuration / "scenes" / "dual_pushing.yaml")
    others = run_arms_offline(scene, load_task(configuration / "tasks" / "dual_pushing.yaml", scene.name))
    live, offline = (body_poses(arms["leader"])[1][-1] for arms in (run, others))
    assert np.linalg.norm(live[:3, 3] - offline[:3, 3]) < 3e-3
    assert np.degrees(np.arccos((np.trace(live[:3, :3].T @ offline[:3, :3]) - 1.0) / 2.0)) < 3.0


def test_a_recorded_push_has_a_report_with_its_picture(finished, tmp_path):
    launch, _ = finished
    assert main(["report", str(launch.folder / "bag"), "--out", str(tmp_path)]) == 0
    assert (tmp_path / "leader" / "push.png").stat().st_size > 20_000
