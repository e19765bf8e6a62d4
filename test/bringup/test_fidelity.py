"""Levels of fidelity in the loop without ROS: what the network sees, drawn at its size, leads as well."""

import numpy as np
import pytest

from tactile_bringup.offline import OfflineOptions, run_offline
from tactile_control.task_file import load_task, task_path
from tactile_scene.scene_file import load_scene

TASK = ["follower.task.timeout=1.5"]


@pytest.fixture(scope="module")
def runs():
    task = load_task(task_path("surface_following"), "plane", changes=TASK)
    return {
        fidelity: run_offline("plane", task, OfflineOptions(fidelity=fidelity, seed=4))
        for fidelity in ("image", "input")
    }


def test_both_follow_the_surface_alike(runs):
    ends, depths = [], []
    for record in runs.values():
        working = record.working(record.pose.stamp_ns)
        ends.append(record.pose.T_base_sensor[working][-1])
        depths.append(record.truth.T_fs[record.working(record.truth.stamp_ns), 2, 3].mean())
    assert np.linalg.norm(ends[0][:3, 3] - ends[1][:3, 3]) < 5e-4
    assert abs(depths[0] - depths[1]) < 1e-4


def test_both_feel_contact_and_estimate_as_often(runs):
    counts = [len(record.estimate) for record in runs.values()]
    assert counts[0] > 90 and abs(counts[0] - counts[1]) <= 3


def test_settings_of_the_skin_stay_where_only_the_drawing_changes():
    scene = load_scene("pushing")
    soft = {name: scene.with_fidelity(name).simulation.sensors["arm"] for name in ("image", "input")}
    assert soft["image"].model == soft["input"].model
    assert soft["input"].model.skin.gel_modulus == 40000.0
    assert (soft["image"].fidelity, soft["input"].fidelity) == ("image", "input")
