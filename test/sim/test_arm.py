"""The simulated arm: limits, watchdog, refusals, rest."""

import numpy as np
import pytest

from tactile_base.settings import SettingError
from tactile_geometry import se3
from tactile_scene import _native
from tactile_scene.arm import ArmMode
from tactile_scene.arm_settings import ArmLimits
from tactile_sim.arm import SimArm

MS = 1_000_000
TASK_TWIST = np.array([0.0, 0.010, 0.0, 0.05, 0.0, 0.0])  # the paper's 10 mm/s, with some turning


def drive(arm, twist, steps, step_ns=1 * MS, record=None):
    """Command a twist before every step."""
    for _ in range(steps):
        arm.command(arm.stamp_ns, twist)
        arm.advance_to(arm.stamp_ns + step_ns)
        if record is not None:
            record.append(arm.twist)


def coast(arm, steps, step_ns=1 * MS, record=None):
    """Steps without commands."""
    for _ in range(steps):
        arm.advance_to(arm.stamp_ns + step_ns)
        if record is not None:
            record.append(arm.twist)


def random_commands(settings, seed, n=40):
    """Twists up to three times over the velocity limits, held for 1 to 80 ms each."""
    rng = np.random.default_rng(seed)
    scale = np.repeat([settings.linear_velocity, settings.angular_velocity], 3)
    return [(rng.uniform(-3, 3, 6) * scale, int(rng.integers(1, 80))) for _ in range(n)]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("settings", [ArmLimits(), ArmLimits(linear_jerk=5.0, angular_acceleration=2.0)])
def test_no_limit_is_exceeded_whatever_is_commanded(settings, seed):
    arm, twists = SimArm(settings), [np.zeros(6)]
    for twist, steps in random_commands(settings, seed):
        short = _native.shortened(twist, settings.linear_velocity, settings.angular_velocity)
        drive(arm, short, steps, record=twists)
    coast(arm, 1000, record=twists)
    velocity = np.array(twists)
    acceleration = np.diff(velocity, axis=0) / 1e-3
    jerk = np.diff(acceleration, axis=0) / 1e-3
    s = settings
    for part, v, a, j in (
        (slice(0, 3), s.linear_velocity, s.linear_acceleration, s.linear_jerk),
        (slice(3, 6), s.angular_velocity, s.angular_acceleration, s.angular_jerk),
    ):
        assert np.abs(velocity[:, part]).max() <= v * (1 + 1e-9)
        assert np.abs(acceleration[:, part]).max() <= a * (1 + 1e-6)
        assert np.abs(jerk[:, part]).max() <= j * (1 + 1e-6)
        assert np.abs(acceleration[:, part]).max() > 0.5 * a  # the limits were worked against
    assert not twists[-1].any()


@pytest.mark.parametrize("rate", [60, 120, 1000])
def test_the_arm_is_at_rest_within_200_ms_of_the_last_command(rate):
    arm, step = SimArm(), 10**9 // rate
    drive(arm, TASK_TWIST, rate, step)
    last_command = arm.stamp_ns - step
    coast(arm, round(0.2 * rate) - 1, step)
    assert arm.stamp_ns - last_command <= 200 * MS
    assert not arm.twist.any()
    assert arm.state.mode is ArmMode.RESTING
    assert "no command for 0.1" in arm.state.reason
    assert "limit 0.1 s" in arm.state.reason


def test_the_arm_says_that_it_is_stopping_while_it_does():
    arm = SimArm()
    drive(arm, TASK_TWIST, 200)
    coast(arm, 105)
    assert arm.state.mode is ArmMode.STOPPING
    assert 0 < np.linalg.norm(arm.twist[:3]) < 0.010


def test_a_new_command_ends_a_stop():
    arm = SimArm()
    drive(arm, TASK_TWIST, 200)
    coast(arm, 150)
    drive(arm, TASK_TWIST, 100)
    assert arm.state.mode is ArmMode.MOVING
    assert arm.state.reason == ""
    np.testing.assert_allclose(arm.twist, TASK_TWIST, atol=1e-12)


def test_at_rest_the_pose_does_not_change_by_a_bit():
    arm = SimArm(T_base_controlled=se3.exp(np.array([0.3, -0.1, 0.2, 1.0, 2.0, -0.5])))
    drive(arm, TASK_TWIST, 200)
    coast(arm, 300)
    pose = arm.T_base_controlled
    coast(arm, 1000)
    drive(arm, np.zeros(6), 1000)
    assert (arm.T_base_controlled == pose).all()


def test_a_command_of_zero_is_rest_without_a_complaint():
    arm = SimArm()
    drive(arm, TASK_TWIST, 200)
    drive(arm, np.zeros(6), 200)
    assert arm.state.mode is ArmMode.RESTING
    assert arm.state.reason == ""


def test_a_steady_twist_is_followed_exactly_on_the_group():
    start = se3.exp(np.array([0.1, 0.2, 0.3, -1.0, 0.5, 0.2]))
    arm = SimArm(T_base_controlled=start)
    twist = np.array([0.02, 0.01, -0.03, 0.3, -0.2, 0.4])
    drive(arm, twist, 500)
    before = arm.T_base_controlled
    drive(arm, twist, 2000)
    np.testing.assert_allclose(arm.T_base_controlled, before @ se3.exp(2.0 * twist), atol=1e-12)


def test_poses_do_not_depend_on_how_time_is_cut_in_steps():
    fine, coarse = SimArm(), SimArm()
    for arm in (fine, coarse):
        arm.command(0, [0.02, 0.01, 0.0, 0.0, 0.0, 0.0])
    for _ in range(50):
        fine.advance(0.001)
    coarse.advance(0.05)
    assert fine.stamp_ns == coarse.stamp_ns == 50 * MS
    np.testing.assert_allclose(fine.T_base_controlled, coarse.T_base_controlled, atol=1e-12)
    np.testing.assert_allclose(fine.twist, coarse.twist, atol=1e-12)


def test_the_rotation_stays_orthonormal_over_an_hour_of_motion():
    arm = SimArm()
    for _ in range(3600 * 10):
        arm.command(arm.stamp_ns, [0.01, 0.0, 0.0, 0.3, 0.9, -0.2])
        arm.advance(0.1)
    R = arm.T_base_controlled[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-13)


def test_the_same_commands_give_the_same_bits():
    poses = []
    for _ in range(2):
        arm = SimArm()
        for twist, steps in random_commands(arm.limits, seed=7):
            drive(arm, twist, steps)
        poses.append(arm.T_base_controlled)
    assert (poses[0] == poses[1]).all()


def test_an_arm_without_any_command_stays_where_it_is():
    start = se3.exp(np.array([0.3, -0.1, 0.2, 1.0, 2.0, -0.5]))
    arm = SimArm(T_base_controlled=start)
    coast(arm, 500)
    assert (arm.T_base_controlled == start).all()


def test_an_arm_in_fault_stops_within_its_limits_and_follows_nothing_until_it_recovers():
    arm, twists = SimArm(), []
    drive(arm, TASK_TWIST, 200)
    arm.fault("pressed too hard")
    drive(arm, TASK_TWIST, 200, record=twists)
    assert arm.state.mode is ArmMode.FAULT
    assert arm.state.reason == "pressed too hard"
    jerk = np.abs(np.diff(twists, n=2, axis=0)).max(axis=0) / 1e-6
    assert (jerk <= np.repeat([arm.limits.linear_jerk, arm.limits.angular_jerk], 3) * (1 + 1e-6)).all()
    assert not twists[-1].any()
    arm.recover()
    coast(arm, 5)
    assert arm.state.mode is ArmMode.RESTING
    drive(arm, TASK_TWIST, 100)
    np.testing.assert_allclose(arm.twist, TASK_TWIST, atol=1e-12)


def test_time_cannot_go_back():
    arm = SimArm(stamp_ns=1000)
    with pytest.raises(ValueError, match="500 ns before"):
        arm.advance_to(500)


def test_a_limit_of_zero_is_refused():
    with pytest.raises(SettingError, match="linear_jerk"):
        ArmLimits(linear_jerk=0.0)
