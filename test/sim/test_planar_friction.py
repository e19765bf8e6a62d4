"""Friction models: Coulomb's law itself as the oracle, gradients, convexity, and what a fit finds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_sim.planar_friction import ConvexPolynomial, Ellipsoid, PointCoulomb

POINTS = np.array([[-0.6, -0.5], [1.1, -0.4], [-0.3, 1.2], [0.5, 0.7]])
FRICTION = np.array([1.0, 0.5, 2.0, 0.7])
COULOMB = PointCoulomb(POINTS, FRICTION)
ELLIPSOID = Ellipsoid(3.0, 0.8)

directions = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


def law(motion):
    """The load that a floor takes from a moving body, each point by itself."""
    load = np.zeros(3)
    for (x, y), most in zip(POINTS, FRICTION, strict=True):
        speed = np.array([motion[0] - motion[2] * y, motion[1] + motion[2] * x])
        force = most * speed / np.linalg.norm(speed)
        load += [*force, x * force[1] - y * force[0]]
    return load


def unit(vector):
    return np.asarray(vector) / np.linalg.norm(vector)


@settings(max_examples=200, deadline=None)
@given(directions)
def test_the_motion_under_coulombs_load_is_the_one_that_makes_it(motion):
    motion = unit(motion)
    speeds = [np.hypot(motion[0] - motion[2] * y, motion[1] + motion[2] * x) for x, y in POINTS]
    if min(speeds) < 1e-2:  # next to a point that stays, any load within that point's friction fits
        return
    load = law(motion)
    np.testing.assert_allclose(COULOMB.motion(load), motion, atol=1e-4)
    assert COULOMB.size(load) == pytest.approx(1.0, abs=1e-6)
    assert COULOMB.size(2.0 * load) == pytest.approx(2.0, abs=1e-6)


def test_a_body_that_turns_about_one_of_its_points_is_found_at_that_corner():
    x, y = POINTS[2]
    motion = unit([y, -x, 1.0])
    load = sum(
        (law_of(k, motion) for k in range(4) if k != 2), start=np.zeros(3)
    )  # the third point stays, and carries nothing here
    np.testing.assert_allclose(COULOMB.motion(load), motion, atol=1e-3)


def law_of(k, motion):
    x, y = POINTS[k]
    speed = np.array([motion[0] - motion[2] * y, motion[1] + motion[2] * x])
    force = FRICTION[k] * speed / np.linalg.norm(speed)
    return np.array([*force, x * force[1] - y * force[0]])


@given(directions)
def test_many_loads_at_once_are_as_each_alone(load):
    loads = np.array([load, [1.0, 0.0, 0.0], [0.0, 0.2, -1.0]])
    for model in (COULOMB, ELLIPSOID):
        for one, found in zip(loads, model.motion(loads), strict=True):
            np.testing.assert_allclose(model.motion(one), found, atol=1e-6)


def random_polynomial(seed):
    factors = np.random.default_rng(seed).normal(size=(3, 3, 3))
    return ConvexPolynomial(factors @ np.swapaxes(factors, 1, 2))


@given(directions, st.integers(0, 100))
def test_motions_are_along_the_gradient_of_the_size(load, seed):
    for model in (ELLIPSOID, random_polynomial(seed)):
        numeric = [(model.size(load + step) - model.size(load - step)) for step in 1e-6 * np.eye(3)]
        np.testing.assert_allclose(model.motion(np.array(load)), unit(numeric), atol=1e-4)


@given(directions, directions, st.floats(0.0, 1.0), st.integers(0, 100))
def test_polynomials_are_convex_and_their_size_scales_with_the_load(one, other, part, seed):
    model, one, other = random_polynomial(seed), np.array(one), np.array(other)
    between = model.value(part * one + (1.0 - part) * other)
    assert between <= part * model.value(one) + (1.0 - part) * model.value(other) + 1e-9
    assert model.size(3.0 * one) == pytest.approx(3.0 * model.size(one))


def test_a_fit_to_coulombs_law_is_nearer_to_it_than_the_ellipsoid():
    random = np.random.default_rng(0)
    motions = random.normal(size=(200, 3))
    motions /= np.linalg.norm(motions, axis=1)[:, None]
    loads = np.array([law(motion) for motion in motions])
    start = Ellipsoid(FRICTION.sum(), float(FRICTION @ np.hypot(*POINTS.T) / FRICTION.sum()))
    fitted = ConvexPolynomial.fit(loads[:100], motions[:100], start)

    def error(model):
        cosine = (model.motion(loads[100:]) * motions[100:]).sum(axis=1)
        return np.median(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))

    assert error(fitted) < 0.6 * error(start)
    assert np.median(fitted.size(loads[100:])) == pytest.approx(1.0, abs=0.05)
