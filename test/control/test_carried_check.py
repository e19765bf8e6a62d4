"""What another arm carries: its tool says how the surface moves, and the depth is held against that."""

import numpy as np
import pytest

from tactile_control.carried_check import CarriedCheck
from tactile_control.phases import StampedPose
from tactile_control.surface_check import SurfaceSettings
from tactile_geometry import se3

ERROR = 0.0013
FRAME_NS = 16_666_667
GRIP = se3.pose_from_euler([0.01, -0.02, 0.08, 0.1, 0.2, -0.3])  # T_tool_sensor while nothing drifts


def tool(t):
    """T_world_tool, to and fro by 80 mm and 23 degrees."""
    return se3.exp(np.sin(np.array([0.4, 0.5, 0.6, 0.7, 0.3, 0.8]) * t) * ([0.08] * 3 + [0.4] * 3))


def believed(z):
    return se3.inverse(se3.pose_from_euler([0.0, 0.0, z, 0.0, 0.0, 0.0]))


def fed(check, seconds, into, late_ns=20_000_000, begins=0.0):
    """Believe 4 mm while the sensor goes into what is carried by `into` m/s; when that is known, s."""
    for k in range(round(60 * seconds)):
        t, stamp_ns = begins + k / 60, round((1.0 + begins) * 1e9) + k * FRAME_NS
        heard_ns = stamp_ns - late_ns
        if heard_ns > 0:
            check.hear(StampedPose(heard_ns, tool(t - late_ns / 1e9)))
        sensor = tool(t) @ GRIP @ se3.pose_from_euler([0.0, 0.0, into * (t - begins), 0.0, 0.0, 0.0])
        check.add(stamp_ns, believed(0.004), sensor)
        if check.contradiction:
            return k / 60
    return None


@pytest.fixture
def check():
    return CarriedCheck(SurfaceSettings(carried=True, carried_error=ERROR, speed=0.05, turn_rate=0.5))


@pytest.mark.parametrize("late_ns", [0, 5_000_000, 40_000_000])
def test_an_arm_that_keeps_its_contact_on_what_is_carried_around_is_believed(check, late_ns):
    assert fed(check, 15.0, 0.0, late_ns) is None and check.doubt < 0.05


@pytest.mark.parametrize("into", [0.001, -0.001, 0.0003])
def test_one_that_goes_in_or_out_while_its_depth_is_told_to_stay_is_not(check, into):
    when = fed(check, 10.0, into)
    assert ERROR / abs(into) < when < ERROR / abs(into) + 0.3
    assert "seen from the arm that carries the object" in check.contradiction and check.pace() == 0.0


def test_what_gives_way_in_its_grip_leaves_more_room_to_a_tip_that_presses():
    check = CarriedCheck(SurfaceSettings(carried=True, carried_error=ERROR, carried_yields=0.002))
    assert 3.3 < fed(check, 10.0, 0.001) < 3.7


def test_without_an_arm_that_carries_it_or_its_word_nothing_is_held_against_it(check):
    assert fed(CarriedCheck(SurfaceSettings()), 5.0, 0.001) is None
    assert fed(check, 5.0, 0.001, late_ns=10**12) is None and check.doubt == 0.0


def test_a_new_contact_is_another_one(check):
    assert fed(check, 1.0, 0.001) is None
    check.begin()
    assert fed(check, 1.0, 0.001, begins=3.0) is None
