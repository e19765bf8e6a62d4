"""Steering by a learnt model: how an object turns is found on the way, and used up to the target."""

import re

import numpy as np
import pytest
from kinematic_plant import run
from test_alignment import TARGET
from test_pushing import CONTROLLERS, plant_with, target_error

from tactile_base.settings import SettingError
from tactile_control.steering import SteeringController, SteeringSettings, TurningModel
from tactile_control.task_file import load_controller
from tactile_control.tasks.pushing import Pushing, PushingGoal, PushingSettings
from tactile_geometry import se3

DOWN = np.array([0.0, 0.0, -1.0])
STEP = 1.0 / 60.0


def moved(model, turning, drift, sideways, ahead=0.010, noise=0.0, seed=0):
    """The model after a contact that went sideways at these speeds (m/s), one for each 1/60 s."""
    rng = np.random.default_rng(seed)
    position, normal = np.zeros(3), np.array([0.0, 1.0, 0.0])
    model.update(position, normal, DOWN)
    for u in sideways:
        y, z = u * STEP, ahead * STEP
        position = position + y * np.cross(normal, DOWN) + z * normal
        normal = turned(normal, turning * y + drift * z)
        model.update(position, turned(normal, noise * rng.standard_normal()), DOWN)
    return model


def turned(vector, angle):
    return se3.exp(np.concatenate([np.zeros(3), angle * DOWN]))[:3, :3] @ vector


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize(("turning", "drift"), [(6.0, 0.0), (14.0, 1.5), (10.0, -2.0)])
def test_how_the_object_turns_is_found_from_its_motion(turning, drift, noise):
    """Sideways at up to 15 mm/s to and fro for 10 s."""
    sideways = 0.015 * np.sin(np.arange(600) * STEP * 1.5)
    model = moved(TurningModel(SteeringSettings()), turning, drift, sideways, noise=noise)
    assert model.turning == pytest.approx(turning, abs=1.0)
    assert model.drift == pytest.approx(drift, abs=0.3)


def test_a_contact_that_stands_still_teaches_nothing():
    settings = SteeringSettings()
    model = moved(TurningModel(settings), 0.0, 0.0, np.zeros(600), ahead=0.0, noise=0.01)
    assert model.turning == pytest.approx(settings.turning)
    assert model.drift == pytest.approx(0.0, abs=1e-9)


def test_an_object_that_has_changed_is_learnt_anew():
    sideways = 0.015 * np.sin(np.arange(900) * STEP * 1.5)
    model = moved(TurningModel(SteeringSettings()), 6.0, 0.0, sideways)
    assert moved(model, 14.0, 0.0, sideways).turning == pytest.approx(14.0, abs=1.5)


def test_without_sideways_motion_what_was_learnt_of_the_turning_is_forgotten():
    """After 200 mm straight ahead, more than three times the memory, the assumed 10 / m is back."""
    sideways = 0.015 * np.sin(np.arange(600) * STEP * 1.5)
    model = moved(TurningModel(SteeringSettings()), 16.0, 0.0, sideways)
    assert model.turning == pytest.approx(16.0, abs=0.5)
    assert moved(model, 16.0, 0.0, np.zeros(1200)).turning < 13.0


def test_the_sideways_velocity_changes_its_sign_where_the_bearing_answers_the_other_way():
    """1 / r = alpha / r0: at a = 10 / m, 100 mm from the target."""
    steering = SteeringController(SteeringSettings(turning=10.0))
    far, at, near = (steering.step(np.array([0.0, 0.002, z]), 0.0, 0.02)[1] for z in (0.2, 0.1, 0.05))
    assert far < 0.0 < near and abs(at) < 1e-12


def test_the_sideways_velocity_is_clipped():
    steering = SteeringController(SteeringSettings(limit=0.012))
    assert steering.step(np.array([0.0, -0.3, 0.3]), 0.01, 0.02)[1] == 0.012


@pytest.mark.parametrize("drift", [-2.0, 2.0])
def test_an_object_whose_centre_of_friction_lies_beside_the_contact_arrives(request, drift):
    """Target alignment, switched off near the target, leaves more than a centimetre."""
    controllers = request.config.rootpath / CONTROLLERS
    paper = load_controller(controllers / "pushing.yaml", PushingSettings())
    errors = []
    for settings in (paper, paper.replaced(steering__enabled=True)):
        plant = plant_with(drift=drift)
        plant.noise = np.array([2e-4, 2e-4, 2e-4, 0.01, 0.01, 0.01])
        run(Pushing(settings, PushingGoal(target=TARGET)), plant)
        errors.append(target_error(plant.surface))
    assert errors[0] > 0.010 and errors[1] < 0.002


# ---- to a pose ----


def ended(request, angle_deg, speed=0.010, changes=None, **face):
    """A push that is to end at an angle to the left of the world's x-axis: last command, and plant."""
    controllers = request.config.rootpath / CONTROLLERS
    settings = load_controller(controllers / "pushing_tuned.yaml", PushingSettings())
    settings = settings.replaced(task__speed=speed, **(changes or {}))
    plant = plant_with(**face)
    plant.noise = np.array([2e-4, 2e-4, 2e-4, 0.01, 0.01, 0.01])
    goal = PushingGoal(target=TARGET, direction=pointing(angle_deg))
    return run(Pushing(settings, goal), plant)[-1][1], plant


def pointing(angle_deg):
    return np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg)), 0.0


@pytest.mark.parametrize("drift", [-1.0, 0.0, 1.0])
@pytest.mark.parametrize("angle_deg", [-30.0, 0.0, 30.0])
def test_an_object_arrives_in_the_direction_that_the_goal_gives(request, angle_deg, drift):
    command, plant = ended(request, angle_deg, drift=drift)
    assert command.succeeded and target_error(plant.surface) < 0.004
    heading = np.degrees(np.arctan2(plant.surface.normal[1], plant.surface.normal[0]))
    assert heading == pytest.approx(angle_deg, abs=3.0)


def test_a_direction_that_the_object_cannot_be_turned_to_on_the_way_is_refused_before_it_moves(request):
    command, plant = ended(request, -170.0)
    assert not command.succeeded and np.allclose(plant.surface.normal, [0.0, 1.0, 0.0])
    assert re.search(r"needs a curve of \d+ mm radius, .* along one of 67 mm at the tightest", command.reason)


@pytest.mark.parametrize(
    ("direction", "changes", "reason"),
    [
        ((1.0, 0.0, 0.0), {"steering__enabled": False}, "with steering alone: set steering.enabled"),
        ((1.0, 0.0, 0.3), {}, "points 17 deg out of the plane"),
    ],
)
def test_a_direction_that_makes_no_sense_is_refused_with_what_would(request, direction, changes, reason):
    settings = load_controller(
        request.config.rootpath / CONTROLLERS / "pushing_tuned.yaml", PushingSettings()
    ).replaced(**changes)
    command = run(Pushing(settings, PushingGoal(target=TARGET, direction=direction)), plant_with())[-1][1]
    assert reason in command.reason


def test_of_a_direction_that_is_none_the_goal_says_so():
    with pytest.raises(SettingError, match="direction: must be 3 numbers that are not all zero"):
        PushingGoal(target=TARGET, direction=(0.0, 0.0, 0.0))


def test_a_direction_in_the_world_is_turned_into_the_base():
    T_world_base = np.eye(4)
    T_world_base[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    goal = PushingGoal(target=TARGET, direction=(0.0, 1.0, 0.0), frame="world").in_base(T_world_base)
    np.testing.assert_allclose(goal.direction, [1.0, 0.0, 0.0], atol=1e-12)
    assert PushingGoal(target=TARGET, frame="world").in_base(T_world_base).direction == ()
