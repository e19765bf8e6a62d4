"""Steering by a learnt model: how an object turns is found on the way, and used up to the target."""

import numpy as np
import pytest
from kinematic_plant import run
from test_alignment import TARGET
from test_pushing import CONTROLLERS, plant_with, target_error

from tactile_control.steering import SteeringController, SteeringSettings, TurningModel
from tactile_control.task_file import load_controller
from tactile_control.tasks.pushing import Pushing, PushingGoal, PushingSettings
from tactile_filter import se3

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
    assert np.sqrt(model.covariance[0, 0]) == pytest.approx(settings.turning_deviation, rel=0.01)


def test_an_object_that_has_changed_is_learnt_anew():
    sideways = 0.015 * np.sin(np.arange(900) * STEP * 1.5)
    model = moved(TurningModel(SteeringSettings()), 6.0, 0.0, sideways)
    assert moved(model, 14.0, 0.0, sideways).turning == pytest.approx(14.0, abs=1.5)


def test_a_straight_way_ahead_makes_the_turning_less_certain_again():
    sideways = 0.015 * np.sin(np.arange(600) * STEP * 1.5)
    model = moved(TurningModel(SteeringSettings()), 10.0, 0.0, sideways)
    known = model.covariance[0, 0]
    assert moved(model, 10.0, 0.0, np.zeros(1200)).covariance[0, 0] > 2.0 * known


def test_the_sideways_velocity_changes_its_sign_where_the_bearing_answers_the_other_way():
    """1 / r = alpha / r0: at a = 10 / m, 100 mm from the target."""
    steering = SteeringController(SteeringSettings(turning=10.0, turning_deviation=0.01))
    far, at, near = (steering.step(np.array([0.0, 0.002, z]), 0.0)[1] for z in (0.2, 0.1, 0.05))
    assert far < 0.0 < near and abs(at) < 1e-12


def test_what_is_hardly_known_is_used_with_caution():
    sure, unsure = (SteeringSettings(turning_deviation=deviation) for deviation in (0.1, 10.0))
    target = np.array([0.0, 0.002, 0.2])
    assert abs(SteeringController(unsure).step(target, 0.01)[1]) < abs(
        0.5 * SteeringController(sure).step(target, 0.01)[1]
    )


def test_the_sideways_velocity_is_clipped():
    steering = SteeringController(SteeringSettings(limit=0.012))
    assert steering.step(np.array([0.0, -0.3, 0.3]), 0.01)[1] == 0.012


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
