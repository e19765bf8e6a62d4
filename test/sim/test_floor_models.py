"""Laws of friction that a scene's objects can have, against Coulomb's law and the least power of friction."""

import numpy as np
import pytest
from pushed_cell import SPEED, place, push, scene
from scipy.optimize import minimize_scalar

from tactile_base.settings import SettingError
from tactile_sim.cell import Cell
from tactile_sim.floor_models import floor_model
from tactile_sim.limit_surface import Foot, return_to_surface
from tactile_sim.planar_friction import ConvexPolynomial

FOOT = Foot.around([[-0.04, -0.04], [0.04, -0.04], [0.04, 0.04], [-0.04, 0.04]])
LENGTH = 0.08 / np.sqrt(6)  # radius of gyration of that square
LEGS = (-0.03, -0.03, 0.035, -0.02, 0.0, 0.03, 0.01, -0.035)
SQUARES = (0.9, 0.1, 0.05, 0.7, 0.0, 0.6, 0.3, -0.1, 0.1, 0.6, 0.2, 1.0)
FORCE = 1.4  # N


def springs(seed):
    """Stiffness (3, 3) of soft ones all around and two tips, one of which slips, and a load."""
    rng = np.random.default_rng(seed)
    K = 300.0 * np.diag([1.0, 1.0, LENGTH**2])
    for slip in (0.0, rng.uniform(-0.1, 0.1)):
        x, y = rng.uniform(-0.05, 0.05, 2)
        G = np.array([[1, 0, -y], [0, 1, x]])
        n = rng.standard_normal(2)
        n /= np.linalg.norm(n)
        t = np.array([-n[1], n[0]])
        along, across = 10 ** rng.uniform(2, 5, 2)
        K += G.T @ (along * np.outer(n + slip * t, n) + (slip == 0.0) * across * np.outer(t, t)) @ G
    return K, 4.0 * rng.standard_normal(3) * [FORCE, FORCE, FORCE * LENGTH]


def shares(points):
    """Of the load with its centre in the origin: those next to equal ones."""
    even = np.full(len(points), 1.0 / len(points))
    arms = np.vstack([points.T, np.ones(len(points))])
    return even + np.linalg.lstsq(arms, np.array([0.0, 0.0, 1.0]) - arms @ even, rcond=None)[0]


def coulomb(motion, points):
    """What a floor takes from points that slide: each friction against its own motion."""
    velocity = motion[:2] + motion[2] * np.stack([-points[:, 1], points[:, 0]], axis=1)
    force = FORCE * shares(points)[:, None] * velocity / np.linalg.norm(velocity, axis=1)[:, None]
    return np.array([*force.sum(axis=0), (points[:, 0] * force[:, 1] - points[:, 1] * force[:, 0]).sum()])


@pytest.mark.parametrize("seed", range(30))
@pytest.mark.parametrize("given", [LEGS, ()])
def test_points_take_by_coulombs_law_what_the_springs_leave(seed, given):
    K, load = springs(seed)
    model = floor_model("points", FOOT, given, (), np.eye(2))
    motion, left = return_to_surface(load, K, FORCE, FORCE * FOOT.arm, model)
    np.testing.assert_allclose(left, load - K @ motion, atol=1e-9 * (1 + np.abs(load).max()))
    if motion.any():
        speed = motion[:2] + motion[2] * np.stack([-model[1][:, 1], model[1][:, 0]], axis=1)
        if np.linalg.norm(speed, axis=1).min() > 1e-5:
            np.testing.assert_allclose(left, coulomb(motion, model[1]), atol=2e-4 * FORCE)
    else:
        rng = np.random.default_rng(seed)
        for other in rng.standard_normal((200, 3)) * [1.0, 1.0, 1.0 / LENGTH]:
            assert load @ other <= coulomb(other, model[1]) @ other + 1e-9


@pytest.mark.parametrize("seed", range(30))
def test_a_polynomial_carries_a_load_on_its_surface_and_moves_along_its_normal(seed):
    K, load = springs(seed)
    model = floor_model("polynomial", FOOT, (), SQUARES, np.eye(2))
    motion, left = return_to_surface(load, K, FORCE, FORCE * FOOT.arm, model)
    np.testing.assert_allclose(left, load - K @ motion, atol=1e-9 * (1 + np.abs(load).max()))
    law = ConvexPolynomial(model[1].reshape(-1, 3, 3))
    unit = left / (FORCE * np.array([1.0, 1.0, LENGTH]))
    if not motion.any():
        assert law.size(unit) <= 1.0
        return
    assert law.size(unit) == pytest.approx(1.0, abs=1e-6)
    way = motion * [1.0, 1.0, LENGTH]
    np.testing.assert_allclose(way / np.linalg.norm(way), law.motion(unit), atol=1e-5)


def test_a_polynomial_that_is_the_ellipsoid_is_the_ellipsoid():
    ratio = (LENGTH / FOOT.arm) ** 2
    model = floor_model("polynomial", FOOT, (), (1.0, 0.0, 0.0, 1.0, 0.0, ratio), np.eye(2))
    for seed in range(10):
        K, load = springs(seed)
        for ours, theirs in zip(
            return_to_surface(load, K, FORCE, FORCE * FOOT.arm, model),
            return_to_surface(load, K, FORCE, FORCE * FOOT.arm),
            strict=True,
        ):
            np.testing.assert_allclose(ours, theirs, atol=1e-8)


def power(model, motion, points):
    """Of friction, over that of 1 N: the largest that a load on the limit surface does on a motion."""
    if model == "points":
        velocity = motion[:2] + motion[2] * np.stack([-points[:, 1], points[:, 0]], axis=1)
        return shares(points) @ np.linalg.norm(velocity, axis=1)
    return np.max(points @ motion)  # loads on the surface


@pytest.mark.parametrize("turn", [0.0, 90.0])
@pytest.mark.parametrize("model", ["points", "polynomial"])
def test_a_tip_that_sticks_turns_the_object_as_costs_the_least_power(tmp_path, model, turn):
    """Of all turns with the contact's velocity given, for a centre of pressure at the height of the floor."""
    cell = Cell(
        scene(
            tmp_path, (0.01,), turn=turn, height=0.001, friction_tip=5.0, friction=0.3, model=model,
            points=LEGS, polynomial=SQUARES, skin_force=845.0, skin_shear=105300.0,
        )
    )  # fmt: skip
    push(cell, 0.5)
    before = place(cell)
    push(cell, 0.1)
    moved = (place(cell) - before) / (0.1 * SPEED)
    R = np.array([[0, -1], [1, 0]]) if turn else np.eye(2)
    contact = np.array([0.01, -0.04])
    if model == "points":
        law = np.reshape(LEGS, (-1, 2)) @ R.T
    else:
        matrices = floor_model("polynomial", FOOT, (), SQUARES, R)[1].reshape(-1, 3, 3)
        loads = np.random.default_rng(0).standard_normal((100_000, 3))
        loads /= ConvexPolynomial(matrices).size(loads)[:, None]
        law = loads * [1.0, 1.0, LENGTH]

    def of(turning):
        velocity = np.array([0.0, 1.0]) - turning * np.array([-contact[1], contact[0]])
        return power(model, np.array([*velocity, turning]), law)

    least = minimize_scalar(of, bounds=(-40.0, 40.0), method="bounded", options={"xatol": 1e-4}).x
    assert abs(least) > 2.0
    assert moved[2] == pytest.approx(least, rel=0.06)


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"model": "points", "points": (0.0, 0.0, 0.01)}, "points: 3 numbers, must be x and y of 3 to 400"),
        ({"model": "points", "points": (0.0, 0.0, 0.0, 0.06, 0.01, 0.0)}, r"\[0.0, 0.06\] lies 20.0 mm"),
        ({"model": "polynomial"}, "polynomial: 0 numbers, must be six for each matrix"),
        ({"model": "polynomial", "polynomial": (1, 0, 0, -1, 0, 1)}, "must be positive semidefinite"),
        ({"model": "elipsoid"}, "model = 'elipsoid': must be one of ellipsoid, points, polynomial"),
    ],
)  # fmt: skip
def test_numbers_that_are_no_law_of_friction_are_refused(tmp_path, settings, message):
    with pytest.raises(SettingError, match=message):
        Cell(scene(tmp_path, **settings))
