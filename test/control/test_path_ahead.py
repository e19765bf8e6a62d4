"""Where a task says that it leads is where the arm arrives, and nothing is said of a task that has ended."""

import numpy as np
import pytest
from kinematic_plant import Plane, Plant, PushedFace, PushingPlant, Sphere, pointing_down, run
from test_alignment import TARGET, pushing_along_y

from tactile_control.task_file import load_controller
from tactile_control.tasks.move import Move, MoveGoal, MoveTaskSettings
from tactile_control.tasks.pushing import Pushing, PushingGoal, PushingSettings
from tactile_control.tasks.surface_following import FollowingGoal, SurfaceFollowing, SurfaceFollowingSettings
from tactile_control.tasks.trajectory import Trajectory, TrajectoryGoal, TrajectoryTaskSettings

START = pointing_down((0.0, 0.0, 0.024))


def said(task, plant):
    """Phase, where the sensor is, and what lies ahead (n, 3), in each step of a run that succeeds."""
    rows = []

    def look(k, command):
        ahead = np.array([T[:3, 3] for T in task.ahead()]).reshape(-1, 3)
        rows.append((command.phase, plant.T[:3, 3].copy(), ahead))

    assert run(task, plant, each=look)[-1][1].succeeded
    assert len(rows[-1][2]) == 0, "it is at its end"
    return rows


def of(rows, phase):
    found = [(at, ahead) for name, at, ahead in rows if name == phase]
    return found, found[-1][0]


@pytest.mark.parametrize("surface", [Plane(), Sphere(0.2)], ids=["plane", "sphere"])
def test_following_leads_straight_on_by_the_way_that_is_left(request, surface):
    path = request.config.rootpath / "config/controllers/surface_following.yaml"
    settings = load_controller(path, SurfaceFollowingSettings())
    start = pointing_down(surface.top() + START[:3, 3])
    task = SurfaceFollowing(settings, FollowingGoal(direction_deg=90.0, length=0.03))
    rows, end = of(said(task, Plant(surface, start)), "follow")
    for at, ahead in rows[::30]:
        left = np.linalg.norm(end - at)
        assert np.linalg.norm(ahead[-1] - at) == pytest.approx(left, abs=1e-3)
        bend = 0.0 if isinstance(surface, Plane) else left**2 / (2 * 0.2)  # which the task does not know
        np.testing.assert_allclose(ahead[-1], end, atol=1e-3 + bend)


def test_a_push_leads_to_its_target(request):
    path = request.config.rootpath / "config/controllers/pushing.yaml"
    settings, T = load_controller(path, PushingSettings()), pushing_along_y()
    plant = PushingPlant(PushedFace(T[:3, 3] + 0.025 * T[:3, 2], T[:3, 2], 12.0), T)
    rows = said(Pushing(settings, PushingGoal(target=TARGET), T), plant)
    assert {tuple(ahead[-1]) for phase, _, ahead in rows if phase in ("approach", "push")} == {tuple(TARGET)}
    assert not any(
        tuple(ahead[-1]) == TARGET for phase, _, ahead in rows if phase == "retreat" and len(ahead)
    )


def test_a_trajectory_leads_along_what_is_left_of_it():
    goal = TrajectoryGoal(displacement=(0.03, 0.0, 0.01, 0.0, 0.0, 0.0))
    rows, end = of(said(Trajectory(TrajectoryTaskSettings(), goal), Plant(Plane(), START)), "move")
    for at, ahead in rows[1::20]:
        np.testing.assert_allclose(ahead[0], at, atol=2e-3)
        np.testing.assert_allclose(ahead[-1], end, atol=1e-3)


def test_a_move_leads_to_its_pose_by_way_of_the_air():
    there = (0.02, -0.03, 0.04)
    rows, _ = of(said(Move(MoveTaskSettings(), MoveGoal(there), None), Plant(Plane(), START)), "move")
    for _, ahead in rows[:-1:10]:
        np.testing.assert_allclose(ahead[-1], there)
