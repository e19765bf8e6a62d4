"""Friction that differs over the floor and with speed: statistics of the field, and what an object feels."""

import numpy as np
import pytest
from pushed_cell import SPEED, place, push, scene

from tactile_sim.cell import Cell
from tactile_sim.floor_field import FloorField
from tactile_sim.pushed import PushedSettings

WEIGHT = 0.479 * 9.81
SEED = 10


def test_a_field_has_its_mean_deviation_and_length():
    rng = np.random.default_rng(0)
    fields = [FloorField(0.1, 0.05, seed) for seed in range(400)]
    start = rng.uniform(-1.0, 1.0, (20, 2))
    apart = start + np.array([0.05, 0.0])  # one length: exp(-1/2)
    here, there = (np.array([field(points) for field in fields]) for points in (start, apart))
    assert here.mean() == pytest.approx(1.0, abs=0.01)
    assert here.std() == pytest.approx(0.1, rel=0.05)
    assert np.corrcoef(here.ravel(), there.ravel())[0, 1] == pytest.approx(np.exp(-0.5), abs=0.05)


def pressed(cell, built, seconds, speed):
    """Force of a tip that pushes through the middle, by its depth."""
    settings = PushedSettings(**built.bodies["pushed"].motion_settings.values)
    return settings.normal_force(push(cell, seconds, (0.0, speed))[-1].truth.depth)


def test_a_foot_has_the_mean_of_the_field_under_it_and_its_centre_where_there_is_more(tmp_path):
    built = scene(
        tmp_path, friction=0.3, friction_field=0.3, friction_field_length=0.3, friction_field_seed=SEED
    )
    cell, field = Cell(built), FloorField(0.3, 0.3, SEED)
    push(cell, 2.0)
    force = pressed(cell, built, 0.2, SPEED)
    x, y, turn = place(cell)
    points = np.stack(np.meshgrid(*2 * [np.linspace(-0.04, 0.04, 81)]), axis=-1).reshape(-1, 2)
    friction = field(points @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]] + [x, y])
    assert abs(friction.mean() - 1.0) > 0.03
    assert force == pytest.approx(0.3 * friction.mean() * WEIGHT, rel=0.01)
    right = points[:, 0] @ friction  # more friction to the right turns it that way, clockwise
    assert abs(turn) > np.radians(0.2) and np.sign(turn) == -np.sign(right)


def test_another_seed_is_another_floor_and_the_same_is_the_same(tmp_path):
    ends = []
    for seed in (1, 1, 2):
        cell = Cell(scene(tmp_path, friction_field=0.3, friction_field_seed=seed))
        push(cell, 1.0)
        ends.append(cell.T_world_body("pushed").tobytes())
    assert ends[0] == ends[1] != ends[2]


def test_friction_grows_with_the_speed(tmp_path):
    built = scene(tmp_path, friction=0.3, friction_speed=0.2)
    cell = Cell(built)
    push(cell, 0.5, (0.0, SPEED))
    usual, fast = (pressed(cell, built, 0.5, speed) for speed in (SPEED, 0.1))
    assert usual == pytest.approx(0.3 * WEIGHT, rel=0.01)
    assert fast == pytest.approx(1.2 * usual, rel=0.02)
