"""Laws in arrays against those of one task; the plan of predictive steering against a general optimizer."""

import numpy as np
import pytest
from kinematic_plant import run
from scipy.optimize import minimize
from test_alignment import TARGET
from test_pushing import CONTROLLERS, plant_with, target_error

from tactile_base.array_math import NUMBERS, array_math
from tactile_control.pid import PidSettings, TangentPid
from tactile_control.plane_tasks import ArrayPid
from tactile_control.predictive_steering import STEPS, Plan
from tactile_control.steering import SteeringController, SteeringSettings
from tactile_control.task_file import load_controller
from tactile_control.tasks.pushing import Pushing, PushingGoal, PushingSettings

NUMPY = array_math()
GAINS = PidSettings(
    kp=[1.0, 0.5, 2.0, 1.0, 0.0, 3.0], ki=[0.1, 4.0, 0.5, 0.0, 2.0, 1.0], kd=[0.1, 0.0, 0.2, 0.1, 0.0, 0.0],
    integral_limit=[0.025, np.inf, 0.2, 25.0, 0.01, np.inf],
    output_limit=[np.inf, 0.02, np.inf, 0.1, np.inf, 0.05],
)  # fmt: skip


def test_the_pid_of_many_is_that_of_one():
    random, count, dt = np.random.default_rng(1), 8, 1 / 60
    pids, channels = [TangentPid(GAINS) for _ in range(count)], range(6)
    array = ArrayPid(GAINS, channels, count, NUMPY)
    error = np.zeros((6, count))
    begins, integrates = np.arange(count) * 3, np.arange(count) % 3 > 0
    for step in range(200):
        error = 0.98 * error + 0.01 * random.standard_normal((6, count))
        active = step >= begins
        found = array.step(error, dt, active, integrates)
        for k in np.flatnonzero(active):
            one, *_ = pids[k].update(round((step + 1) * dt * 1e9), error[:, k], not integrates[k])
            np.testing.assert_allclose(found[:, k], one, atol=1e-7)


def test_steering_of_many_is_that_of_one():
    random = np.random.default_rng(2)
    settings = SteeringSettings()
    many = SteeringController(settings, NUMPY, np.zeros(5))
    each = [SteeringController(settings) for _ in range(5)]
    for _ in range(50):
        left, ahead, turned = (scale * random.standard_normal(5) for scale in (2e-4, 2e-4, 5e-3))
        many.model.advance(left, abs(ahead), turned)
        y, z = 0.1 * random.standard_normal(5), random.uniform(0.02, 0.3, 5)
        found = many.sideways(y, z, 0.01, 0.02)
        for k, one in enumerate(each):
            one.model.advance(float(left[k]), float(abs(ahead[k])), float(turned[k]))
            assert found[k] == pytest.approx(one.sideways(float(y[k]), float(z[k]), 0.01, 0.02), abs=1e-9)


# ---- predictive steering ----


def cost(slopes, settings, model, y, z, radius):
    """What a plan is to make least of, with the ways integrated as it does."""
    (a, b), piece, total = model, (np.hypot(y, z) - radius) / STEPS, 0.0
    for slope in slopes:
        total += piece * (slope**2 + (y / settings.reach) ** 2)
        turn = a * slope + b
        y, z = y + piece * (turn * z - slope), z - piece * (1.0 + turn * y)
    return total + (piece + settings.end_way) * (y / settings.reach) ** 2


@pytest.mark.parametrize("model", [(10.0, 0.0), (14.0, 1.5), (6.0, -2.0)])
@pytest.mark.parametrize(("y", "z"), [(0.02, 0.3), (-0.2, 0.25), (0.01, 0.06)])
def test_no_other_plan_costs_less(model, y, z):
    settings = SteeringSettings(law="predictive")
    plan = Plan(NUMBERS, 0.0)
    for _ in range(30):
        plan.step(settings, model, y, z, 0.02)
    args = (settings, model, y, z, 0.02)
    best = minimize(cost, np.zeros(STEPS), args, bounds=[(-settings.cone, settings.cone)] * STEPS)
    found = cost(plan.slopes, *args)
    assert max(abs(slope) for slope in plan.slopes) <= settings.cone
    assert found <= 1.02 * best.fun + 1e-7


@pytest.mark.parametrize("drift", [-2.0, 0.0, 2.0])
def test_a_push_by_plans_arrives(request, drift):
    settings = load_controller(
        request.config.rootpath / CONTROLLERS / "pushing_tuned.yaml", PushingSettings()
    )
    plant = plant_with(drift=drift)
    plant.noise = np.array([2e-4, 2e-4, 2e-4, 0.01, 0.01, 0.01])
    commands = run(Pushing(settings, PushingGoal(target=TARGET)), plant)
    assert commands[-1][1].succeeded and target_error(plant.surface) < 0.002
