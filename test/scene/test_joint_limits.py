"""What the joints of an arm with known kinematics allow of a twist."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_geometry import se3
from tactile_scene.kinematics.arm_file import load_arm
from tactile_scene.kinematics.joint_limits import (
    allowed_part,
    joint_rates,
    limited_rates,
    smallest_singular_value,
)

ARM = replace(load_arm("ur5e"), velocity=np.full(6, 2.0), acceleration=np.full(6, 10.0))
READY = np.array([0.0, -1.6, 1.8, -1.8, -1.57, 0.0])
STRETCHED = np.array([0.3, -1.0, 0.01, -1.8, -1.57, 0.0])  # the elbow cannot reach further


def allowed(q, twist, **changes):
    arm = replace(ARM, **changes)
    rates = joint_rates(arm, q, np.asarray(twist, dtype=float))
    return allowed_part(arm, q, rates, 0.02, 0.03, 0.01)


def go(q, twist, seconds, step=0.005, **changes):
    """Follow what is allowed of a twist; the joint angles on the way."""
    path = [q]
    for _ in range(round(seconds / step)):
        part, _ = allowed(path[-1], twist, **changes)
        rates = np.linalg.lstsq(ARM.jacobian(path[-1]), part * np.asarray(twist), rcond=None)[0]
        path.append(path[-1] + step * rates)
    return np.array(path)


def test_in_the_middle_of_everything_the_whole_twist_is_allowed():
    assert allowed(READY, [0.05, -0.03, 0.02, 0.1, 0.2, -0.1]) == (1.0, "")
    assert allowed(READY, np.zeros(6)) == (1.0, "")


def test_no_joint_is_faster_than_it_may_be():
    twist = np.array([0, 0, 0, 0, 0, 3.0])
    part, reason = allowed(READY, twist)
    rates = np.linalg.solve(ARM.jacobian(READY), part * twist)
    assert np.abs(rates).max() == pytest.approx(2.0) and reason == "joint 6"


@pytest.mark.parametrize("speed", [0.01, 3.0])
def test_speeds_of_the_joints_make_the_twist_or_the_largest_part_of_it_that_they_may(speed):
    twist = speed * np.array([0.3, -0.2, 0.1, 0.5, 0.4, -1.0])
    whole = np.linalg.solve(ARM.jacobian(READY), twist)
    part = min(1.0, 2.0 / np.abs(whole).max())
    rates = limited_rates(ARM, READY, twist)
    np.testing.assert_allclose(rates, part * whole, rtol=1e-9)
    assert np.abs(rates).max() <= 2.0 and (part < 1.0) == (speed > 1.0)
    step = 1e-6  # what the pose becomes in a moment
    moved = se3.log(se3.inverse(ARM.pose(READY)) @ ARM.pose(READY + step * rates)) / step
    np.testing.assert_allclose(moved, part * twist, atol=1e-5 * speed)


def test_a_joint_comes_to_rest_before_the_end_of_its_range_and_may_go_back():
    upper = np.array([np.pi, np.pi, np.pi, np.pi, np.pi, 0.2])
    turning = [0, 0, 0, 0, 0, 1.0]
    path = go(READY, turning, 2.0, upper=upper)
    assert 0.19 < path[-1, 5] <= 0.2
    assert np.abs(np.diff(path[:, 5], n=2)).max() / 0.005**2 < 1.2 * 10.0  # it brakes as it can
    assert allowed(path[-1], [0, 0, 0, 0, 0, -1.0], upper=upper) == (1.0, "")


def test_towards_a_singularity_the_arm_slows_down_and_stops_and_away_from_it_it_does_not():
    outward = np.zeros(6)
    T, elbow = ARM.pose(STRETCHED), np.array([0, 0, -0.3, 0, 0, 0])
    way = T[:3, :3].T @ (T[:3, 3] - ARM.pose(STRETCHED + elbow)[:3, 3])
    outward[:3] = 0.02 * way / np.linalg.norm(way)
    near = STRETCHED.copy()
    near[2] = 0.5
    path = go(near, outward, 30.0, step=0.05)
    values = [smallest_singular_value(ARM, q) for q in path]
    assert values[0] > 0.03 and 0.0095 < min(values) < 0.012
    assert allowed(path[-1], outward) == (pytest.approx(0.0, abs=0.1), "singularity")
    assert allowed(path[-1], -outward)[0] > 0.9
