"""The task `touching` on the simulated cell: where it touches, how it moves there, what it refuses."""

import dataclasses

import numpy as np
import pytest

from tactile_base.settings import SettingError
from tactile_bringup.offline import OfflineOptions, run_offline
from tactile_control.task_file import NamedGoal, Role, Task
from tactile_control.tasks.touching import PRESS, TOUCH, TouchingGoal, TouchingTaskSettings
from tactile_scene.scene_file import load_scene

SWING = (0.002, 0.0, 0.001, 0.0, 6.0, 0.0)  # m and degrees


def run(goal, scene="plane", **settings):
    values = TouchingTaskSettings().replaced(**settings) if settings else TouchingTaskSettings()
    role = Role("toucher", "touching", values, (NamedGoal("touches", goal),))
    scene = load_scene(scene) if isinstance(scene, str) else scene
    return run_offline(
        scene, Task("touches", scene.name, (role,)), OfflineOptions(fidelity="ideal", time_limit=60.0)
    )


@pytest.fixture(scope="module")
def touches():
    return run(TouchingGoal(upright=3, tilted=2, tilt_deg=16.0, depth=0.002, rest=0.1))


@pytest.fixture(scope="module")
def swung():
    return run(TouchingGoal(depth=0.003, swing=SWING, period=1.0, periods=2))


def stretches(record, phase):
    """First and last index of the poses of each time in a phase."""
    inside = np.concatenate([[False], record.phase_at(record.pose.stamp_ns) == phase, [False]])
    edges = np.flatnonzero(np.diff(inside.astype(int)))
    return list(zip(edges[::2], edges[1::2] - 1, strict=True))


def test_all_places_are_touched_at_their_tilts_slowly_and_left_again(touches):
    assert touches.result["succeeded"], touches.result["reason"]
    found = stretches(touches, PRESS)
    assert len(found) == 5
    T = touches.pose.T_base_sensor[[first for first, _ in found]]
    up = -T[:, 2, 2]  # the table's normal is the base's z
    np.testing.assert_allclose(np.degrees(np.arccos(up)), [0.0, 0.0, 0.0, 16.0, 8.0], atol=0.2)
    middle = T[:3, :2, 3].mean(axis=0)
    np.testing.assert_allclose(np.linalg.norm(T[:3, :2, 3] - middle, axis=1), 0.010, atol=1e-3)
    for first, last in stretches(touches, TOUCH):
        steps = np.diff(touches.pose.T_base_sensor[first + 10 : last + 1, :3, 3], axis=0)  # slowed down
        assert np.linalg.norm(steps, axis=1).max() < 0.0021 / 120
    assert touches.truth.in_contact[-1] == 0
    assert touches.pose.T_base_sensor[-1, 2, 3] == pytest.approx(0.032, abs=2e-3)  # at the start's height


def test_a_contact_is_pressed_to_its_depth(touches):
    depth = touches.truth.T_fs[:, 2, 3]
    for first, last in stretches(touches, PRESS):
        stamps = touches.pose.stamp_ns[[first, last]]
        inside = (touches.truth.stamp_ns >= stamps[0]) & (touches.truth.stamp_ns <= stamps[1])
        # from the touch, which is seen a little late
        assert 0.0019 < depth[inside].max() < 0.0024


def test_the_sensor_swings_along_and_about_one_axis_after_the_other(swung):
    assert swung.result["succeeded"], swung.result["reason"]
    ((first, last),) = stretches(swung, PRESS)
    T = swung.pose.T_base_sensor[first:last]
    T0 = T[0]
    offset = (T[:, :3, 3] - T0[:3, 3]) @ T0[:3, :3]
    turn = np.degrees(np.arcsin((T0[:3, :3].T @ T[:, :3, :3])[:, 0, 2]))
    assert np.abs(offset[:, 0]).max() == pytest.approx(0.002, rel=0.15)
    assert offset[:, 2].max() == pytest.approx(0.004, rel=0.1)
    assert np.abs(offset[:, 1]).max() < 1e-4
    assert np.abs(turn).max() == pytest.approx(6.0, rel=0.15)
    swings_along_x, swings_about_y = np.abs(offset[:, 0]).argmax(), np.abs(turn).argmax()
    assert swings_along_x < offset[:, 2].argmax() < swings_about_y


def test_without_a_surface_it_gives_up_and_comes_back():
    record = run(TouchingGoal(), task__search=0.005)
    assert not record.result["succeeded"]
    assert "no contact within 5.0 mm over touch 1" in record.result["reason"]
    assert record.pose.T_base_sensor[-1, 2, 3] == pytest.approx(0.032, abs=2e-3)


def test_a_contact_that_ends_on_the_way_fails_the_task():
    goal = TouchingGoal(depth=0.0005, swing=(0.0, 0.0, 0.003, 0.0, 0.0, 0.0), period=4.0, periods=2)
    record = run(goal)
    assert "contact was lost in touch 1" in record.result["reason"]


def test_something_in_the_way_stops_it():
    scene = load_scene("plane")
    arm = scene.arms["arm"]
    start = arm.T_world_start.copy()
    start[2, 3] = 0.0185  # in the table
    low = dataclasses.replace(scene, arms={"arm": dataclasses.replace(arm, T_world_start=start)})
    record = run(TouchingGoal(), low)
    assert "touched something 6 mm off the surface: set task.clearance" in record.result["reason"]


def test_nothing_to_touch_is_no_goal():
    with pytest.raises(SettingError, match="upright and tilted are zero"):
        TouchingGoal(upright=0)
