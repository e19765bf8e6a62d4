"""Two arms with roles over real DDS: the leader waits for the follower, and its end ends the run."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from launched import launch_to_end

from tactile_base.config_paths import config_folder
from tactile_records.runs.object_tracking import numbers

pytest.importorskip("rclpy", reason="needs ROS 2")
pytestmark = [pytest.mark.ros, pytest.mark.slow]

# a machine that holds up a process only delays the task
PATIENT = "watchdog: {patience: 30.0, start_timeout: 60.0}"
CONTACT = "contact: {approach_timeout: 100.0, settle_timeout: 100.0}"


@pytest.fixture(scope="module")
def configuration(tmp_path_factory) -> Path:
    """The shipped configuration with a tenth of a period, and a sensor without images."""
    folder = tmp_path_factory.mktemp("configuration") / "config"
    shutil.copytree(config_folder(), folder)
    task, scene = folder / "tasks" / "object_tracking.yaml", folder / "scenes" / "tracking_flat.yaml"
    text, changed = re.subn(r"periods: 3\b", "periods: 0.1", task.read_text())
    assert changed == 1
    text = text.replace("    task: trajectory\n", f"    task: trajectory\n    settings: {{{PATIENT}}}\n")
    text = text.replace(
        "    task: object_tracking\n", f"    task: object_tracking\n    settings: {{{PATIENT}, {CONTACT}}}\n"
    )
    task.write_text(text)
    scene.write_text(scene.read_text() + "simulation: {sensors: {follower: {fidelity: ideal}}}\n")
    return folder


@pytest.fixture(scope="module")
def finished(tmp_path_factory, configuration):
    """One run to its end: the launch and the records of both arms."""
    folder = tmp_path_factory.mktemp("finished")
    return launch_to_end(folder, "object_tracking", configuration, "periodic leader: move")


def test_the_run_ends_well_with_the_leader_and_nothing_is_left(finished):
    launch, run = finished
    assert launch.process.returncode == 0, launch.output
    assert "leader: [1/1] periodic: done" in launch.output
    assert "follower: [1/1] track: done" in launch.output
    assert launch.leaves_nothing(), launch.left()
    assert {name: record.role for name, record in run.items()} == {"leader": "leader", "follower": "follower"}
    assert all(record.result["succeeded"] for record in run.values())


def test_the_leader_waits_for_the_followers_contact(finished):
    _, run = finished
    leader, follower = run["leader"].command, run["follower"].command
    tracking = follower.stamp_ns[follower.phase == "track"]
    assert leader.stamp_ns[leader.phase == "move"][0] > tracking[0]
    assert leader.stamp_ns[leader.phase == "move"][-1] < tracking[-1]
    assert follower.phase[-1] == "done"


def test_the_bag_tells_how_closely_the_plate_was_tracked(finished):
    _, run = finished
    values = numbers(run["follower"], run)
    assert values["contact_fraction"] == 1.0
    track = values["tracking"]
    assert track["leader"] == "leader" and track["seconds"] > 3.0
    assert all(np.isfinite(track["rms"][name]) and track["rms"][name] < 4.0 for name in track["rms"])
