"""The move task on a small plant: it arrives within its speeds, or rests and says why not."""

import dataclasses
import re

import numpy as np
import pytest
from kinematic_plant import MS, Plane, Plant, pointing_down, run
from scipy.spatial.transform import Rotation

from tactile_base.settings import SettingError
from tactile_control.free_task import MOVE
from tactile_control.phases import DONE, FAILED, GO_TO_START
from tactile_control.tasks.move import Move, MoveGoal, MoveTaskSettings
from tactile_geometry import se3

START = pointing_down((0.3, 0.1, 0.2))
THERE = (0.32, 0.07, 0.23)


class Held(Plant):
    """An arm that is kept below a height."""

    def step(self, twist):
        super().step(twist)
        self.T[2, 3] = min(self.T[2, 3], 0.21)


def moved(goal, plant=None, start=None, **more):
    """The plant after a run, and its commands."""
    plant = plant or Plant(Plane(), START)
    return plant, [command for _, command, _, _ in run(Move(MoveTaskSettings(), goal, start), plant, **more)]


@pytest.mark.parametrize("rotation_deg", [(), (170.0, 10.0, -20.0)], ids=["as it is", "turned"])
@pytest.mark.parametrize("start", [None, pointing_down((0.29, 0.1, 0.2))], ids=["from here", "from a start"])
def test_the_pose_is_reached_within_the_travel_speeds_and_the_arm_rests(rotation_deg, start):
    plant, commands = moved(MoveGoal(THERE, rotation_deg), start=start)
    travel = MoveTaskSettings().travel
    assert commands[-1].succeeded and not commands[-1].twist.any()
    assert [phase for phase in (GO_TO_START, MOVE, DONE) if phase in {c.phase for c in commands}][-1] == DONE
    assert np.linalg.norm(plant.T[:3, 3] - THERE) < 2 * travel.position_tolerance
    turn = Rotation.from_euler("xyz", rotation_deg, degrees=True) if rotation_deg else None
    wanted = turn.as_matrix() if turn is not None else START[:3, :3]
    assert Rotation.from_matrix(wanted.T @ plant.T[:3, :3]).magnitude() < 2 * travel.angle_tolerance
    twists = np.array([command.twist for command in commands])
    assert np.linalg.norm(twists[:, :3], axis=1).max() <= travel.speed + 1e-9
    assert np.linalg.norm(twists[:, 3:], axis=1).max() <= travel.angular_speed + 1e-9
    progress = [command.progress for command in commands]
    assert progress == sorted(progress) and progress[-1] == 1.0


def test_a_pose_that_stops_coming_brings_the_arm_to_rest_within_200_ms_and_ends_the_move():
    lost = 30
    kept = {}

    def lose(k, inputs):
        kept.setdefault("pose", inputs.sensor_pose)
        if k <= lost:
            kept["pose"] = inputs.sensor_pose
        return dataclasses.replace(inputs, sensor_pose=kept["pose"])

    plant = Plant(Plane(), START)
    task = Move(MoveTaskSettings(), MoveGoal(THERE))
    commands = run(task, plant, change=lose)
    since_ns = commands[lost][0]
    moving = [now_ns for now_ns, command, _, _ in commands if command.twist.any()]
    assert moving[-1] > since_ns and (moving[-1] - since_ns) / MS < 200
    assert commands[-1][1].phase == FAILED and "pose is" in commands[-1][1].reason


def test_an_arm_that_is_limited_by_ends_the_move_with_how_far_it_is_from_the_pose():
    plant, commands = moved(MoveGoal(THERE), Held(Plane(), START))
    assert commands[-1].phase == FAILED and not commands[-1].twist.any()
    told = re.match(r"the arm comes no nearer than ([\d.]+) mm to the pose", commands[-1].reason)
    assert float(told[1]) == pytest.approx(1e3 * np.linalg.norm(plant.T[:3, 3] - THERE), abs=2.0)
    assert plant.now_ns < 10e9  # not only when the longest way has passed


def test_a_move_that_touches_something_rests_there_and_a_next_one_may_leave():
    plant, commands = moved(MoveGoal((0.3, 0.1, 0.0)), Plant(Plane(), pointing_down((0.3, 0.1, 0.04))))
    assert (commands[-1].phase, commands[-1].reason) == (FAILED, "touched something on the way")
    assert not commands[-1].twist.any() and 0.0 < plant.depth < 0.006
    _, away = moved(MoveGoal((0.3, 0.1, 0.05)), plant)
    assert away[-1].succeeded and plant.depth < 0.0


def test_a_move_that_is_cancelled_comes_to_rest_where_it_is():
    plant = Plant(Plane(), START)
    task = Move(MoveTaskSettings(), MoveGoal(THERE))
    commands = run(task, plant, each=lambda k, command: task.stop("cancelled") if k == 30 else None)
    assert (commands[-1][1].phase, commands[-1][1].reason) == (FAILED, "cancelled")
    assert np.linalg.norm(se3.log(se3.inverse(START) @ plant.T)[:3]) < 0.05


@pytest.mark.parametrize(
    ("goal", "complaint"),
    [
        ({}, "position: must have 3 elements, has 0"),
        ({"position": (0.0, 0.0)}, "position: must have 3 elements, has 2"),
        ({"position": (0.0, 0.0, 30.0)}, r"position\[2\] = 30.0 m: must lie in"),
        ({"position": (0.0, 0.0, 0.0), "rotation_deg": (1.0,)}, "rotation_deg: must have 0 or 3 elements"),
    ],
)
def test_what_is_no_pose_is_refused(goal, complaint):
    with pytest.raises(SettingError, match=complaint):
        MoveGoal(**goal)
