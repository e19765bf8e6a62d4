"""Two arms that hold an object: it stays as wide as it is, unless the estimates of one of them lie."""

import numpy as np
import pytest

from tactile_control.phases import StampedPose
from tactile_control.surface_check import SurfaceSettings
from tactile_control.width_check import WidthCheck
from tactile_geometry import se3

LIMIT = 0.0014
FRAME_NS = 16_666_667


def facing(way, side=0.0, turn=0.0):
    """T_world_feature at this x and y (m), its normal along x, or turned by an angle about z."""
    T = se3.pose_from_euler([way, side, 0.0, 0.0, 0.0, turn])
    return T @ se3.pose_from_euler([0.0, 0.0, 0.0, 0.0, np.pi / 2, 0.0])


def fed(check, seconds, own, partner, begins=0.0, late_ns=5_000_000):
    """Give both arms' features, by functions of the time (s); the time of a contradiction, or None."""
    for k in range(round(60 * seconds)):
        stamp_ns = round((1.0 + begins) * 1e9) + k * FRAME_NS
        heard_ns = stamp_ns - late_ns
        check.hear(StampedPose(heard_ns, partner(begins + (heard_ns - stamp_ns) / 1e9 + k / 60)))
        check.add(StampedPose(stamp_ns, own(begins + k / 60)))
        if check.contradiction:
            return k / 60
    return None


@pytest.fixture
def check():
    return WidthCheck(SurfaceSettings(width_error=LIMIT))


def pushed(t):
    """The object goes along x, ever faster, to the side, and turns."""
    return se3.pose_from_euler([0.01 * t + 0.002 * t * t, 0.003 * t, 0.0, 0.0, 0.0, 0.1 * t])


def test_an_object_that_is_pushed_and_turned_stays_as_wide_as_it_is_wherever_contacts_slide(check):
    own = lambda t: pushed(t) @ facing(-0.06, side=0.001 * t)  # noqa: E731
    partner = lambda t: pushed(t) @ facing(0.06, side=-0.002 * t, turn=np.pi)  # noqa: E731
    assert fed(check, 8.0, own, partner) is None and check.doubt < 0.02


def test_round_objects_count_with_the_square_of_the_angle_between_the_normals(check):
    """A contact that goes round by 6 degrees: 120 mm (1 - cos 3 degrees) = 0.16 mm."""
    assert fed(check, 1.0, lambda t: _round(0.0), lambda t: _round(np.pi + 0.1 * t)) is None
    assert 0.05 < check.doubt < 0.2


def _round(angle):
    """A feature on a circle about the origin, its normal to the middle."""
    return se3.pose_from_euler([0.0, 0.0, 0.0, 0.0, 0.0, angle]) @ facing(-0.06)


@pytest.mark.parametrize("rate", [0.001, 0.0003])
def test_a_tip_that_goes_deeper_than_it_is_believed_to_makes_the_object_thinner(check, rate):
    when = fed(check, 8.0, lambda t: facing(0.01 * t), lambda t: facing(0.12 + (0.01 - rate) * t, turn=np.pi))
    assert LIMIT / rate < when < LIMIT / rate + 0.25
    assert "the object between both arms became 1." in check.contradiction and check.pace() == 0.0


def test_the_other_way_is_no_contradiction_and_it_can_be_left_out(check):
    away = lambda t: facing(0.12 + 0.001 * t, turn=np.pi)  # noqa: E731
    nearer = lambda t: facing(0.12 - 0.001 * t, turn=np.pi)  # noqa: E731
    assert fed(check, 5.0, lambda t: facing(0.0), away) is None
    for settings in (SurfaceSettings(), SurfaceSettings(width_error=LIMIT, checked=False)):
        check.begin()
        check.configure(settings)
        assert fed(check, 5.0, lambda t: facing(0.0), nearer) is None and check.pace() == 1.0


def test_the_arm_goes_slower_before_it_has_to_stop(check):
    fed(check, 1.3, lambda t: facing(0.0), lambda t: facing(0.12 - 0.001 * t, turn=np.pi))
    assert check.contradiction == "" and 0.7 < check.doubt < 1.0 and 0.25 < check.pace() < 1.0


def test_a_contact_that_was_lost_and_found_again_is_another_one(check):
    own = lambda t: facing(0.0)  # noqa: E731
    assert fed(check, 2.0, own, lambda t: facing(0.12, turn=np.pi)) is None
    assert fed(check, 2.0, own, lambda t: facing(0.11, turn=np.pi), begins=3.0) is None


def test_a_partner_with_another_clock_is_passed_over_until_it_has_the_same(check):
    check.add(StampedPose(10**9, facing(0.0)))
    check.hear(StampedPose(10**12, facing(0.12, turn=np.pi)))
    nearer = lambda t: facing(0.12 - 0.001 * t, turn=np.pi)  # noqa: E731
    assert fed(check, 3.0, lambda t: facing(0.0), nearer, begins=1.0) is not None
