"""Acting on the contact as predicted for now: what latency costs without it, and what it never hides."""

import numpy as np
import pytest
from kinematic_plant import Plant, Sphere, pointing_down, run

from tactile_control.phases import FAILED, TaskInputs
from tactile_control.tasks.surface_following import (
    FOLLOW,
    FollowingGoal,
    SurfaceFollowing,
    SurfaceFollowingSettings,
)

SURFACE = Sphere(0.3)


def settings(**changes):
    base = {
        "pid__kp": (0.0, 0.0, 12.0, 12.0, 12.0, 0.0),
        "pid__ki": (0.0, 0.0, 1.0, 20.0, 20.0, 0.0),
        "task__speed": 0.02,
    }
    return SurfaceFollowingSettings().replaced(**{**base, **changes})


def above():
    start = SURFACE.top() + np.array([0.0, 0.0, 0.023])
    return pointing_down(start)


def followed(delay_steps, **changes):
    """Tilts (rad) and depths (m) in the second half of following, and the last command."""
    plant = Plant(SURFACE, above(), delay_steps=delay_steps)
    commands = run(SurfaceFollowing(settings(**changes), FollowingGoal(length=0.05)), plant)
    rows = [(tilt, depth) for _, command, depth, tilt in commands if command.phase == FOLLOW]
    tilts, depths = np.array(rows[len(rows) // 2 :]).T
    return tilts, depths, commands[-1][1]


def test_with_latency_high_gains_never_settle_unless_the_belief_is_carried_on():
    high = {"pid__kp": (0.0, 0.0, 16.0, 16.0, 16.0, 0.0)}  # 1/s, at 83 ms of latency
    plant = Plant(SURFACE, above(), delay_steps=5)
    once = settings(contact__lost_contact="fail", surface__depth_margin=0.1, **high)
    plain = run(SurfaceFollowing(once, FollowingGoal(length=0.05)), plant)
    assert plain[-1][1].reason == "contact was lost in phase settle", "it swings out of the surface"
    tilts, depths, last = followed(5, prediction__enabled=True, **high)
    assert last.succeeded
    assert np.degrees(tilts).max() < 0.2
    assert np.abs(depths - 0.003).max() < 1e-5


def test_a_surface_taken_as_still_is_followed_with_a_lag_that_its_motion_estimate_removes():
    still, _, _ = followed(3, prediction__enabled=True, prediction__motion_time=0.0, pid__ki=(0.0,) * 6)
    moving, _, _ = followed(3, prediction__enabled=True, prediction__motion_time=0.3, pid__ki=(0.0,) * 6)
    assert moving.mean() < 0.75 * still.mean()


def test_without_latency_and_at_low_gains_it_changes_little():
    low = {"pid__kp": (0.0, 0.0, 2.0, 4.0, 4.0, 0.0), "pid__ki": (0.0, 0.0, 0.1, 4.0, 4.0, 0.0)}
    plain, _, _ = followed(1, **low)
    ahead, _, _ = followed(1, prediction__enabled=True, **low)
    assert ahead.mean() == pytest.approx(plain.mean(), abs=np.radians(0.3))


def test_the_command_still_names_the_exposure_it_rests_on():
    plant = Plant(SURFACE, above(), delay_steps=4)
    commands = run(SurfaceFollowing(settings(prediction__enabled=True), FollowingGoal(length=0.02)), plant)
    ages = [now - command.exposure_ns for now, command, _, _ in commands if command.phase == FOLLOW]
    assert min(ages) >= 4 * plant.period_ns


def test_a_belief_that_stops_coming_stops_the_arm_all_the_same():
    plant = Plant(SURFACE, above(), delay_steps=2)

    def silent(k, inputs):
        lost = plant.now_ns > 4_000_000_000
        return TaskInputs(None, inputs.presence, inputs.sensor_pose) if lost else inputs

    commands = run(
        SurfaceFollowing(settings(prediction__enabled=True), FollowingGoal(length=0.2)),
        plant,
        12.0,
        change=silent,
    )
    assert commands[-1][1].phase == FAILED
    assert "belief" in commands[-1][1].reason


def test_it_can_be_switched_on_and_off_while_it_runs():
    plant = Plant(SURFACE, above(), delay_steps=2)
    task = SurfaceFollowing(settings(), FollowingGoal(length=0.05))

    def switch(k, command):
        task.configure(settings(prediction__enabled=k % 100 < 50))

    commands = run(task, plant, each=switch)
    assert commands[-1][1].succeeded
