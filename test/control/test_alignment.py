"""Target alignment: where the target is seen, and the sideways velocity in the units of the paper's table."""

import numpy as np
import pytest

from tactile_base.settings import SettingError
from tactile_control.alignment import AlignmentController, AlignmentSettings, Bearing, target_bearing
from tactile_control.pid import ControlInputError
from tactile_geometry import se3

STEP = 16_000_000
DT = STEP * 1e-9
PAPER = {"kp": 0.9, "ki": 0.3, "kd": 0.9}
TARGET = (0.375, 0.0, 0.045)


def pushing_along_y(position=(0.1, -0.25, 0.045)):
    """T_base_sensor as in the paper's Task 3: x down, z along the base's y."""
    T = np.eye(4)
    T[:3, :3] = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
    T[:3, 3] = position
    return T


def seen(angle_deg, distance=0.3):
    y, z = distance * np.sin(np.radians(angle_deg)), distance * np.cos(np.radians(angle_deg))
    return Bearing(np.array([0.0, y, z]), angle_deg, distance)


def test_the_papers_target_is_seen_47_7_degrees_to_the_side():
    bearing = target_bearing(TARGET, pushing_along_y())
    assert bearing.angle_deg == pytest.approx(-np.degrees(np.arctan2(275, 250)))
    assert bearing.distance == pytest.approx(np.hypot(0.275, 0.25))
    np.testing.assert_allclose(bearing.position, [0.0, -0.275, 0.25], atol=1e-12)


def test_the_target_is_seen_from_the_reference_frame_not_from_where_the_sensor_is():
    """A sensor that is to turn by 10 degrees and move by 3 mm along z sees the target from there."""
    turn = se3.exp([0.0, 0.0, 0.0, np.radians(10.0), 0.0, 0.0])
    X_ss_reference = turn.copy()
    X_ss_reference[:3, 3] = [0.0, 0.0, 0.003]
    bearing = target_bearing(TARGET, pushing_along_y() @ X_ss_reference)
    expected = np.degrees(np.arctan2(-0.275, 0.247)) + 10.0
    assert bearing.angle_deg == pytest.approx(expected)
    assert bearing.distance == pytest.approx(np.hypot(0.275, 0.247))


def test_the_gains_are_in_mm_per_second_and_degrees():
    control = AlignmentController(AlignmentSettings(**PAPER))
    np.testing.assert_allclose(control.step(0, seen(2.0)), [0.0, -1.8e-3, 0.0, 0.0, 0.0, 0.0])


def test_the_output_is_clipped_at_15_mm_per_second_and_its_integral_does_not_wind_up():
    control = AlignmentController(AlignmentSettings(**PAPER))
    for k in range(100):
        velocity = control.step(k * STEP, seen(-47.7))
    np.testing.assert_allclose(velocity, [0.0, 0.015, 0.0, 0.0, 0.0, 0.0])
    assert not control.pid.integral.any()


def test_the_output_equals_the_written_out_sums():
    control, limit = AlignmentController(AlignmentSettings(**PAPER)), 10.0
    errors = np.random.default_rng(0).uniform(-4.0, 4.0, 40)
    got = [control.step(k * STEP, seen(-error))[1] for k, error in enumerate(errors)]
    integral, smooth, expected = 0.0, errors[0], [0.9 * errors[0]]
    for error in errors[1:]:
        before, smooth = smooth, 0.5 * smooth + 0.5 * error
        law = 0.9 * error + 0.9 * (smooth - before) / DT
        grown = np.clip(integral + error * DT, -limit, limit)
        outwards = abs(law + 0.3 * integral) > 15.0 and (law + 0.3 * integral) * (grown - integral) > 0.0
        integral = integral if outwards else grown
        expected.append(np.clip(law + 0.3 * integral, -15.0, 15.0))
    np.testing.assert_allclose(got, np.array(expected) * 1e-3, rtol=1e-4)


def test_the_integral_of_the_bearing_is_clipped_at_10_degree_seconds():
    control = AlignmentController(AlignmentSettings(ki=0.3))
    for k in range(2000):
        velocity = control.step(k * STEP, seen(-5.0))
    assert velocity[1] == pytest.approx(0.3 * 10.0 * 1e-3)


def test_nearer_than_the_cutoff_distance_there_is_no_output():
    control = AlignmentController(AlignmentSettings(**PAPER, cutoff_distance=0.12))
    assert control.step(0, seen(5.0, 0.121)).any()
    assert not control.step(STEP, seen(5.0, 0.119)).any()


def test_a_bearing_that_is_not_finite_is_refused():
    with pytest.raises(ControlInputError):
        AlignmentController(AlignmentSettings(**PAPER)).step(0, seen(np.nan))


@pytest.mark.parametrize("bad", [{"kp": -1.0}, {"output_limit_mm_s": np.inf}, {"cutoff_distance": np.nan}])
def test_settings_that_make_no_sense_are_refused(bad):
    with pytest.raises(SettingError):
        AlignmentSettings(**bad)
