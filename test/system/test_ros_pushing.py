"""An object is pushed a short way over real DDS: the bag tells of it, the loop without ROS agrees."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from launched import launch_to_end

from tactile_base.config_paths import config_folder
from tactile_bringup.cli import main
from tactile_bringup.offline import run_arms_offline
from tactile_control.task_file import load_task
from tactile_records.runs.pushing import body_poses, numbers
from tactile_scene.scene_file import load_scene

pytest.importorskip("rclpy", reason="needs ROS 2")
pytestmark = [pytest.mark.ros, pytest.mark.slow]

# a machine that holds up a process only delays the task
PATIENT = "watchdog: {patience: 30.0, start_timeout: 60.0}"
CONTACT = "contact: {approach_timeout: 100.0, settle_timeout: 100.0}"
TARGET = "target: [0.105, -0.175, 0.045]"  # 55 mm of pushing


@pytest.fixture(scope="module")
def configuration(tmp_path_factory) -> Path:
    """The shipped configuration with a target near by, and a sensor without images."""
    folder = tmp_path_factory.mktemp("configuration") / "config"
    shutil.copytree(config_folder(), folder)
    task, scene = folder / "tasks" / "pushing.yaml", folder / "scenes" / "pushing.yaml"
    text, changed = re.subn(r"target: \[0\.375, 0\.0, 0\.045\]", TARGET, task.read_text())
    assert changed == 1
    text, changed = re.subn(r"    task: pushing\n", rf"\g<0>    settings: {{{PATIENT}, {CONTACT}}}\n", text)
    assert changed == 1
    task.write_text(text)
    text, changed = re.subn(r"( +)image: \{skin:", r"\1fidelity: ideal\n\1image: {skin:", scene.read_text())
    assert changed == 1
    scene.write_text(text)
    return folder


@pytest.fixture(scope="module")
def finished(tmp_path_factory, configuration):
    """One run to its end: the launch and its record."""
    folder = tmp_path_factory.mktemp("finished")
    return launch_to_end(folder, "pushing", configuration, "arm: push")


def test_the_push_ends_well_and_nothing_is_left(finished):
    launch, run = finished
    assert launch.process.returncode == 0, launch.output
    assert "[1/1] push: done" in launch.output
    assert launch.leaves_nothing(), launch.left()
    assert run["arm"].result["succeeded"]


def test_the_bag_tells_of_contact_body_and_target(finished):
    _, run = finished
    values = numbers(run["arm"], run)
    push = values["push"]
    assert values["contact_fraction"] == 1.0
    assert push["distance_mm"] < 20.5 and push["toppled"] is False
    assert 40.0 < push["body_way_mm"] < 70.0
    assert push["error_mm"] == pytest.approx(-5.0, abs=1.0)  # the target lies 5 mm beside a straight push
    assert push["error_believed_mm"] == pytest.approx(push["error_mm"], abs=1.0)


def test_the_loop_without_ros_pushes_the_body_to_the_same_place(finished, configuration):
    _, run = finished
    scene = load_scene(configuration / "scenes" / "pushing.yaml")
    others = run_arms_offline(scene, load_task(configuration / "tasks" / "pushing.yaml", scene.name))
    live, offline = (body_poses(arms["arm"])[1][-1] for arms in (run, others))
    assert np.linalg.norm(live[:3, 3] - offline[:3, 3]) < 3e-3
    assert np.degrees(np.arccos((np.trace(live[:3, :3].T @ offline[:3, :3]) - 1.0) / 2.0)) < 3.0


def test_a_recorded_push_has_a_report_with_its_picture(finished, tmp_path):
    launch, _ = finished
    assert main(["report", str(launch.folder / "bag"), "--out", str(tmp_path)]) == 0
    assert (tmp_path / "push.png").stat().st_size > 20_000
