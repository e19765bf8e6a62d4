"""Friction of a foot: closed forms, Coulomb's limits, and return mapping against the law that it solves."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_base.settings import SettingError
from tactile_sim.limit_surface import Foot, return_to_surface

SQUARE = [[-0.04, -0.04], [0.04, -0.04], [0.04, 0.04], [-0.04, 0.04]]


def regular(sides, radius):
    angle = 2 * np.pi * np.arange(sides) / sides
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def even_points(foot, count, seed=0):
    """Points spread evenly over a convex polygon."""
    rng = np.random.default_rng(seed)
    low, high = foot.corners.min(axis=0), foot.corners.max(axis=0)
    points = rng.uniform(low, high, (4 * count, 2))
    along = np.roll(foot.corners, -1, axis=0) - foot.corners
    off = points[:, None] - foot.corners
    return points[(along[:, 0] * off[..., 1] - along[:, 1] * off[..., 0] > 0).all(axis=1)][:count]


def test_a_square_foot_resists_turning_as_the_closed_form_says():
    foot = Foot.around(SQUARE)
    assert foot.arm == pytest.approx(0.08 * (np.sqrt(2) + np.arcsinh(1)) / 6, rel=1e-12)
    np.testing.assert_allclose(foot.spread, 0.08**2 / 12 * np.eye(2), atol=1e-15)


def test_a_round_foot_resists_turning_by_two_thirds_of_its_radius():
    foot = Foot.around(regular(720, 0.05))
    assert foot.arm == pytest.approx(2 / 3 * 0.05, rel=1e-4)
    np.testing.assert_allclose(foot.spread, 0.05**2 / 4 * np.eye(2), rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_any_convex_foot_has_the_moments_of_points_spread_over_it(seed):
    foot = Foot.around(np.random.default_rng(seed).uniform(-0.05, 0.05, (12, 2)) + np.array([0.1, -0.2]))
    points = even_points(foot, 100_000)
    np.testing.assert_allclose(foot.center, points.mean(axis=0), atol=3e-4)
    assert foot.arm == pytest.approx(np.hypot(*(points - foot.center).T).mean(), rel=0.01)
    np.testing.assert_allclose(foot.spread, np.cov(points.T), atol=0.02 * foot.spread.max())


@pytest.mark.parametrize("points", [[], [[0, 0]], [[0, 0], [0.1, 0.1], [0.2, 0.2]]])
def test_a_foot_without_area_is_refused(points):
    with pytest.raises(SettingError, match="must be 3 or more that enclose an area"):
        Foot.around(np.reshape(points, (-1, 2)))


def test_a_point_is_inside_by_its_distance_from_the_nearest_edge():
    foot = Foot.around(SQUARE)
    assert foot.inside([0.01, 0.03]) == pytest.approx(0.01)
    assert foot.inside([0.0, 0.05]) == pytest.approx(-0.01)
    edge = foot.edge_before([0.0, 0.05])
    np.testing.assert_allclose([edge[0][1], edge[1][1]], 0.04)


def test_the_edge_takes_load_from_where_a_linear_pressure_leaves_the_far_side():
    foot = Foot.around(SQUARE)
    core = 0.08 / 6  # of a rectangle, from the middle along an axis
    assert foot.edge_share([0.0, 0.999 * core]) == 0.0
    assert 0.0 < foot.edge_share([0.0, 1.1 * core]) < 0.1
    assert foot.edge_share([0.0, 0.04]) == pytest.approx(1.0)
    round_foot = Foot.around(regular(360, 0.04))
    assert round_foot.edge_share([0.99 * 0.01, 0.0]) == 0.0 < round_foot.edge_share([1.01 * 0.01, 0.0])


def load_over_ellipsoid(foot, points, press):
    """Friction and torque of a foot that turns about points all around, over the ellipsoid's."""
    center, used = press @ points, []
    off = points - center
    for distance in 0.08 * np.geomspace(0.02, 20, 20):
        for direction in np.linspace(0, 2 * np.pi, 12, endpoint=False):
            arms = off - distance * np.array([np.cos(direction), np.sin(direction)])
            along = np.column_stack([-arms[:, 1], arms[:, 0]]) / np.hypot(*arms.T)[:, None]
            torque = press @ (off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0])
            used.append(np.hypot(np.linalg.norm(press @ along), torque / foot.arm))
    return np.array(used)


@pytest.mark.parametrize(
    "sides, radius, most_inside", [(4, 0.0566, 0.14), (60, 0.04, 0.125), (6, 0.04, 0.125)]
)
def test_friction_of_pressed_points_is_inside_the_ellipsoid_to_two_parts_in_a_thousand(
    sides, radius, most_inside
):
    foot = Foot.around(regular(sides, radius))
    points = even_points(foot, 8000)
    for ahead in (0.0, 0.5, 1.0):  # of the way of the pressure's centre to the edge of the core
        slope = np.linalg.solve(foot.spread, [0.0, 1.0])
        press = 1.0 + ahead * (points @ slope) / (foot.corners @ slope).max()
        used = load_over_ellipsoid(foot, points, press / press.sum())
        assert 1.0 - most_inside < used.min() and used.max() < 1.002


def springs(rng, count):
    """Stiffness (3, 3) of `count` tips on a foot."""
    K = np.zeros((3, 3))
    for _ in range(count):
        x, y = rng.uniform(-0.05, 0.05, 2)
        G = np.array([[1, 0, -y], [0, 1, x]])
        n = rng.standard_normal(2)
        n /= np.linalg.norm(n)
        along, across = 10 ** rng.uniform(1, 5, 2)
        K += G.T @ ((along - across) * np.outer(n, n) + across * np.eye(2)) @ G
    return K


def used(load, force, torque):
    return np.hypot(np.hypot(load[0], load[1]) / force, load[2] / torque)


@settings(deadline=None, max_examples=300)
@given(
    seed=st.integers(0, 2**32 - 1), tips=st.integers(2, 3), times=st.floats(0.0, 20.0),
    friction=st.floats(0.05, 10.0), arm=st.floats(0.005, 0.05),
)  # fmt: skip
def test_a_foot_on_springs_ends_inside_or_on_the_surface_and_moves_along_its_normal(
    seed, tips, times, friction, arm
):
    rng = np.random.default_rng(seed)
    K, torque = springs(rng, tips), friction * arm
    load = times * rng.standard_normal(3) * [friction, friction, torque]
    motion, left = return_to_surface(load, K, friction, torque)
    assert used(left, friction, torque) <= 1 + 1e-9
    np.testing.assert_allclose(left, load - K @ motion, atol=1e-8 * (1 + np.abs(load).max()))
    if used(load, friction, torque) <= 1:
        assert not motion.any()
        return
    assert used(left, friction, torque) == pytest.approx(1, abs=1e-9)
    assert motion @ left > 0
    normal = left / np.array([friction, friction, torque]) ** 2
    np.testing.assert_allclose(motion / np.linalg.norm(motion), normal / np.linalg.norm(normal), atol=1e-7)


@pytest.mark.parametrize("seed", range(5))
def test_no_other_load_on_the_surface_would_take_more_from_the_motion(seed):
    rng = np.random.default_rng(seed)
    force, torque = 1.4, 0.04
    load = 3 * rng.standard_normal(3) * [force, force, torque]
    motion, left = return_to_surface(load, springs(rng, 2), force, torque)
    others = rng.standard_normal((10_000, 3))
    others *= np.array([force, force, torque]) / np.linalg.norm(others, axis=1, keepdims=True)
    assert (others @ motion).max() <= motion @ left * (1 + 1e-9)
    assert (others @ motion).max() > 0.99 * motion @ left


@pytest.mark.parametrize("seed", range(5))
def test_the_way_hardly_depends_on_the_steps_it_is_cut_into(seed):
    """One tip goes its way; the foot follows in 50, 500 or 5000 steps."""
    rng = np.random.default_rng(seed)
    K, force, torque = springs(rng, 2), 1.4, 0.04
    way = rng.standard_normal(3) * [0.02, 0.02, 0.5]
    ends = []
    for steps in (50, 500, 5000):
        place = np.zeros(3)
        for k in range(1, steps + 1):
            place = place + return_to_surface(K @ (k / steps * way - place), K, force, torque)[0]
        ends.append(place)
    coarse, fine = (np.abs(end - ends[2]).max() for end in ends[:2])
    assert fine <= 0.2 * coarse + 1e-9
    assert fine < 2e-4


def test_a_load_that_no_spring_holds_is_refused():
    K = np.diag([100.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="exceeds friction where no spring holds"):
        return_to_surface([0.0, 2.0, 0.0], K, 1.0, 0.1)
    motion, _ = return_to_surface([2.0, 0.5, 0.0], K, 1.0, 0.1)
    assert motion[0] > 0


def exact_load(points, turn_center):
    """Force and torque over mu N of evenly pressed points that turn, counter-clockwise, about a centre."""
    arms = points - turn_center
    along = np.column_stack([-arms[:, 1], arms[:, 0]]) / np.hypot(*arms.T)[:, None]
    return np.array([*along.mean(axis=0), (points[:, 0] * along[:, 1] - points[:, 1] * along[:, 0]).mean()])


def test_the_ellipsoid_is_within_7_percent_of_the_limit_surface_that_coulomb_gives():
    foot = Foot.around(SQUARE)
    points = even_points(foot, 40_000)
    for distance in 0.08 * np.geomspace(0.02, 20, 25):
        for direction in (0.0, np.pi / 8, np.pi / 4):
            center = distance * np.array([np.cos(direction), np.sin(direction)])
            assert used(exact_load(points, center), 1.0, foot.arm) == pytest.approx(1.0, abs=0.07)
