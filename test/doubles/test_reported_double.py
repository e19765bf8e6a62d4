"""The double of any driver: where the driver says that its arm is, and what it is stopped for."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_doubles.rehearsal import FollowedArm
from tactile_doubles.reported import ReportedDouble
from tactile_geometry import se3
from tactile_scene.scene_file import load_scene
from tactile_sim.cell import Cell

MS = 1_000_000
TWIST = np.array([0.01, 0.0, -0.02, 0.0, 0.1, 0.0])


@pytest.fixture
def arm():
    return load_scene("plane").with_fidelity("ideal").arms["arm"]


def told(double, arm, twist, stamps_ns) -> None:
    """The driver reports an arm that goes with this twist of its controlled frame."""
    T_controlled_tool = se3.inverse(arm.T_tool_controlled)
    for stamp_ns in stamps_ns:
        T = arm.T_base_start @ se3.exp(twist * stamp_ns * 1e-9)
        double.take(stamp_ns, T @ T_controlled_tool)


def test_it_stands_where_the_arm_starts_until_the_driver_says_something(arm):
    stamp_ns, T, twist = ReportedDouble(arm).now()
    assert stamp_ns == 0 and not twist.any()
    np.testing.assert_array_equal(T, arm.T_base_start)


def test_pose_and_twist_are_those_that_the_driver_reports(arm):
    double = ReportedDouble(arm)
    told(double, arm, TWIST, range(0, 200 * MS, 8 * MS))
    stamp_ns, T, twist = double.now()
    assert stamp_ns == 192 * MS
    np.testing.assert_allclose(T, arm.T_base_start @ se3.exp(TWIST * 0.192), atol=1e-12)
    np.testing.assert_allclose(twist, TWIST, atol=1e-9)


@pytest.mark.parametrize("gap_ns", [-50 * MS, 3000 * MS])
def test_a_driver_that_begins_anew_does_not_fly_there(arm, gap_ns):
    double = ReportedDouble(arm)
    told(double, arm, TWIST, range(5000 * MS, 5100 * MS, 8 * MS))
    double.take(5096 * MS + gap_ns, np.eye(4))
    assert not double.now()[2].any()


def test_pressed_too_deep_it_asks_for_a_stop_that_the_cell_alone_cannot_give(arm):
    scene = load_scene("plane").with_fidelity("ideal")
    double = ReportedDouble(arm)
    cell = Cell(replace(scene, arms={"arm": arm}), followed={"arm": FollowedArm(arm, double)})
    period_ns = 1_000_000_000 // scene.simulation.rate
    down = np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0])
    deepest = 0.0
    for _ in range(2 * scene.simulation.rate):
        told(double, arm, down, [cell.stamp_ns + period_ns])
        cell.step()
        deepest = cell.depth("arm")
        if double.stop_asked:
            break
    assert double.stop_asked and 0.005 < deepest < 0.011
