"""The trajectory task on a small plant: where its goal says, at the paper's velocity, or it says why not."""

import dataclasses
import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kinematic_plant import MS, Plane, Plant, pointing_down, run
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from tactile_base.settings import SettingError
from tactile_control.phases import DONE, FAILED, GO_TO_START, STOPPING, StampedPose, TaskInputs
from tactile_control.tasks.trajectory import MOVE, Trajectory, TrajectoryGoal, TrajectoryTaskSettings
from tactile_geometry import se3

START = pointing_down((0.3, 0.1, 0.2))
MM = 1e-3
# the paper's Task 1: 3 periods of 30 s, here five times as fast
OSCILLATION = {"amplitude": (0.05, 0.05, 0.0, 0.0, 0.0, 10.0), "phase_deg": (0.0, 90.0, 0.0, 0.0, 0.0, 0.0)}


def moved(goal, changes=None, start=None, plant=None, **more):
    """The plant after a run, and its commands."""
    plant = plant or Plant(Plane(), START)
    task = Trajectory(TrajectoryTaskSettings().replaced(**(changes or {})), goal, start)
    return plant, run(task, plant, limit_s=200.0, **more)


def error_to(T, T_wanted):
    """Distance (m) and angle (rad)."""
    difference = se3.inverse(T_wanted) @ T
    return np.linalg.norm(difference[:3, 3]), Rotation.from_matrix(difference[:3, :3]).magnitude()


def displaced(displacement):
    """START after a displacement (m, deg) along and about the axes of the base."""
    T = START.copy()
    T[:3, :3] = Rotation.from_rotvec(np.radians(displacement[3:])).as_matrix() @ START[:3, :3]
    T[:3, 3] += displacement[:3]
    return T


def phases_of(commands):
    order = [command.phase for _, command, _, _ in commands]
    return [phase for k, phase in enumerate(order) if k == 0 or order[k - 1] != phase]


def at_step(number, action):
    """Calls the action after that step."""
    return lambda k, command: action() if k == number else None


@pytest.mark.parametrize(
    "displacement",
    [
        (0.05, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.0, -0.03, 0.04, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, 15.0, -10.0, 20.0),
        (0.02, 0.03, -0.01, -10.0, 5.0, 40.0),
    ],
)
def test_a_displacement_ends_where_it_says(displacement):
    plant, commands = moved(TrajectoryGoal(displacement=displacement))
    last = commands[-1][1]
    assert phases_of(commands) == [MOVE, DONE] and last.succeeded and last.progress == 1.0
    distance, angle = error_to(plant.T, displaced(displacement))
    assert distance < 0.4 * MM and angle < np.radians(0.2)  # it ends with its time, the arm's lag short


def test_the_way_of_a_displacement_is_straight_and_as_long_as_it_is():
    poses = []
    plant = Plant(Plane(), START)
    _, commands = moved(
        TrajectoryGoal(displacement=(0.03, 0.04, 0.0, 0.0, 0.0, 0.0)),
        plant=plant,
        each=lambda k, c: poses.append(plant.T[:3, 3] - START[:3, 3]),
    )
    way = np.array(poses)
    across = way - np.outer(way @ [0.6, 0.8, 0.0], [0.6, 0.8, 0.0])
    assert np.linalg.norm(across, axis=1).max() < 0.02 * MM
    assert commands[-1][1].travelled == pytest.approx(0.05, abs=0.3 * MM)


def test_the_slower_of_way_and_turn_says_how_long_it_takes():
    assert TrajectoryGoal(displacement=(0.03, 0, 0, 0, 0, 0)).duration == pytest.approx(2.0)
    both = TrajectoryGoal(displacement=(0.03, 0, 0, 0, 0, 20.0))
    assert both.duration == pytest.approx(4.0)
    assert TrajectoryGoal(amplitude=(0.01, 0, 0, 0, 0, 0), period=5.0, periods=2.0).duration == 10.0


def test_the_papers_oscillation_is_followed_closely():
    goal = TrajectoryGoal(**OSCILLATION, period=30.0, periods=1.0)
    errors = []
    plant = Plant(Plane(), START)
    task = Trajectory(TrajectoryTaskSettings().replaced(task__speed_factor=5.0), goal)
    commands = run(task, plant, each=lambda k, c: errors.append(c.error))
    assert commands[-1][1].succeeded
    moving = np.array([error for error in errors if np.isfinite(error).all()])
    # at 5 times the paper's speed the arm's 20 ms leave 0.05 m 2 pi / 6 s 0.02 s = 1 mm at most
    assert np.linalg.norm(moving[:, :3], axis=1).max() < 1.5 * MM
    assert np.linalg.norm(moving[:, 3:], axis=1).max() < np.radians(0.5)
    assert error_to(plant.T, START)[0] < 1.0 * MM, "whole periods end where they began"


@pytest.mark.parametrize("part", [0.1, 0.37, 0.8])
def test_on_its_way_it_is_where_the_closed_form_says(part):
    """The plant's pose against b (sin(2 pi t / T + phi) - sin phi), with t from the progress."""
    goal = TrajectoryGoal(**OSCILLATION, displacement=(0.02, 0, 0.01, 0, 0, 0), period=20.0, periods=1.0)
    found = []
    plant = Plant(Plane(), START, time_constant=1e-3)

    def look(k, command):
        if command.phase == MOVE and command.progress >= part and not found:
            found.append((command.progress * 20.0, plant.T.copy()))

    moved(goal, plant=plant, each=look)
    t, T = found[0]
    amplitude, phase = np.array(OSCILLATION["amplitude"]), np.radians(OSCILLATION["phase_deg"])
    swing = amplitude * (np.sin(2 * np.pi * t / 20.0 + phase) - np.sin(phase))
    expected = displaced(swing + np.array([0.02, 0, 0.01, 0, 0, 0]) * (t / 20.0))
    distance, angle = error_to(T, expected)
    assert distance < 0.2 * MM and angle < np.radians(0.1)


def test_along_the_axes_of_its_start_a_displacement_is_one_in_the_controlled_frame():
    way = (0.02, 0.03, -0.01, -10.0, 5.0, 40.0)
    plant, _ = moved(TrajectoryGoal(displacement=way, axes="start"))
    T = START.copy()
    T[:3, :3] = START[:3, :3] @ Rotation.from_rotvec(np.radians(way[3:])).as_matrix()
    T[:3, 3] += START[:3, :3] @ way[:3]
    distance, angle = error_to(plant.T, T)
    assert distance < 0.4 * MM and angle < np.radians(0.2)


@pytest.mark.parametrize("periods", [0.3, 1.0, 2.4])
def test_twists_of_the_tool_are_integrated(periods):
    """dT/dt = T [v(t)] for the paper's v(t), all six components, by an ODE solver."""
    b, phase = np.array([0.075] * 3 + [np.radians(25.0)] * 3), np.array([np.pi / 2, 0, 0, 0, 0, 0])
    goal = TrajectoryGoal(
        amplitude=(*b[:3], 25.0, 25.0, 25.0), phase_deg=(90.0, 0, 0, 0, 0, 0), periods=periods, axes="tool"
    )

    def derivative(t, flat):
        v = 2 * np.pi / 30.0 * b * np.cos(2 * np.pi * t / 30.0 + phase)
        x, y, z = v[3:]
        hat = np.array([[0, -z, y, v[0]], [z, 0, -x, v[1]], [-y, x, 0, v[2]], [0, 0, 0, 0]])
        return (flat.reshape(4, 4) @ hat).ravel()

    end = solve_ivp(derivative, (0, 30.0 * periods), START.ravel(), rtol=1e-10, atol=1e-12).y[:, -1]
    plant, commands = moved(goal)
    assert commands[-1][1].succeeded
    distance, angle = error_to(plant.T, end.reshape(4, 4))
    assert distance < 0.4 * MM and angle < np.radians(0.2)


numbers = st.floats(-0.1, 0.1)
angles = st.floats(-180.0, 180.0)


@settings(deadline=None)
@given(
    amplitude=st.lists(numbers, min_size=6, max_size=6).filter(lambda b: np.abs(b).max() > 1e-3),
    phase=st.lists(angles, min_size=6, max_size=6),
    period=st.floats(0.5, 60.0),
    part=st.floats(0.0, 1.0),
)
def test_the_oscillations_velocity_is_the_papers(amplitude, phase, period, part):
    """v(t) = (2 pi b / T) cos(2 pi t / T + phi), against a numerical derivative of the offsets."""
    goal = TrajectoryGoal(amplitude=amplitude, phase_deg=phase, period=period, periods=2.0)
    t, step = part * goal.duration, period * 1e-5
    derivative = (goal.offset(t + step) - goal.offset(t - step)) / (2.0 * step)
    b = np.concatenate([amplitude[:3], np.radians(amplitude[3:])])
    expected = (2 * np.pi * b / period) * np.cos(2 * np.pi * t / period + np.radians(phase))
    np.testing.assert_allclose(derivative, expected, atol=1e-6 * np.abs(2 * np.pi * b / period).max() + 1e-12)


@given(part=st.floats(0.0, 1.0), phase=st.lists(angles, min_size=6, max_size=6))
def test_a_trajectory_begins_where_the_arm_is(part, phase):
    goal = TrajectoryGoal(displacement=[0.02 * part + 1e-3] * 6, amplitude=[0.01] * 6, phase_deg=phase)
    np.testing.assert_array_equal(goal.offset(0.0), np.zeros(6))


def test_it_starts_and_ends_at_rest_without_a_jump():
    _, commands = moved(TrajectoryGoal(displacement=(0.05, 0, 0, 0, 0, 0)))
    speeds = np.array([np.linalg.norm(c.twist[:3]) for _, c, _, _ in commands])
    assert speeds[0] < 0.5 * MM and speeds[-1] == 0.0
    assert speeds.max() == pytest.approx(0.015, rel=0.05)
    assert np.abs(np.diff(speeds)).max() < 2.0 * MM
    moving = [c for _, c, _, _ in commands if c.phase == MOVE]
    assert np.linalg.norm(moving[-1].feedforward[:3]) < 1.5 * MM


def test_an_oscillation_that_begins_at_full_speed_comes_in_smoothly():
    goal = TrajectoryGoal(amplitude=(0.05, 0, 0, 0, 0, 0), period=10.0, periods=1.0)
    _, commands = moved(goal)
    speeds = np.array([np.linalg.norm(c.unlimited[:3]) for _, c, _, _ in commands if c.phase == MOVE])
    assert speeds[0] < 2.0 * MM and np.abs(np.diff(speeds)).max() < 2.5 * MM
    assert speeds.max() == pytest.approx(2 * np.pi * 0.05 / 10.0, rel=0.1)


def test_a_speed_factor_makes_it_as_much_faster():
    goal = TrajectoryGoal(displacement=(0.06, 0, 0, 0, 0, 0))
    durations = [
        sum(
            c.phase == MOVE
            for _, c, _, _ in moved(goal, {"task__speed_factor": f, "task__ramp_time": 0.0})[1]
        )
        for f in (1.0, 2.0)
    ]
    assert durations[0] == pytest.approx(2 * durations[1], abs=2)


def test_a_start_elsewhere_is_gone_to_first():
    start = displaced((0.02, -0.03, 0.01, 0.0, 5.0, 0.0))
    plant, commands = moved(TrajectoryGoal(displacement=(0.02, 0, 0, 0, 0, 0)), start=start)
    assert phases_of(commands) == [GO_TO_START, MOVE, DONE]
    start[0, 3] += 0.02
    distance, angle = error_to(plant.T, start)
    assert distance < 0.3 * MM and angle < np.radians(0.4)  # where travelling calls it reached


def test_without_a_sensor_nothing_but_the_pose_is_needed():
    _, commands = moved(
        TrajectoryGoal(displacement=(0.02, 0, 0, 0, 0, 0)),
        change=lambda k, inputs: TaskInputs(sensor_pose=inputs.sensor_pose),
    )
    assert commands[-1][1].succeeded and not Trajectory.needs_sensor


def test_a_pose_that_stops_coming_brings_the_arm_to_rest_within_200_ms_and_is_named():
    plant, kept = Plant(Plane(), START), []
    silent_ns = plant.now_ns + 2 * 10**9

    def silent(k, inputs):
        if plant.now_ns < silent_ns:
            kept[:] = [inputs]
        return kept[0]

    _, commands = moved(TrajectoryGoal(displacement=(0.06, 0, 0, 0, 0, 0)), plant=plant, change=silent)
    last = commands[-1][1]
    assert last.phase == FAILED and "pose is" in last.reason and "limit 100 ms" in last.reason
    assert max(np.linalg.norm(c.twist[:3]) for now, c, _, _ in commands if now < silent_ns) > 0.01
    moving = [now for now, c, _, _ in commands if np.abs(c.twist).max() > 1e-6]
    assert (moving[-1] - silent_ns) / MS <= 200.0


def test_a_pose_that_is_not_a_number_never_reaches_the_arm():
    def bad(k, inputs):
        return (
            dataclasses.replace(
                inputs, sensor_pose=StampedPose(inputs.sensor_pose.stamp_ns, np.full((4, 4), np.nan))
            )
            if k > 60
            else inputs
        )

    _, commands = moved(TrajectoryGoal(displacement=(0.06, 0, 0, 0, 0, 0)), change=bad)
    assert commands[-1][1].phase == FAILED and "is not finite" in commands[-1][1].reason
    assert all(np.isfinite(c.twist).all() for _, c, _, _ in commands)


def test_a_short_silence_delays_it_and_it_still_ends_where_it_should():
    plant, kept = Plant(Plane(), START), []

    def hiccup(k, inputs):
        if not 100 <= k < 118:
            kept[:] = [inputs]
        return kept[0]

    goal = TrajectoryGoal(displacement=(0.05, 0, 0, 0, 0, 0))
    _, commands = moved(goal, plant=plant, change=hiccup)
    assert any(not c.twist.any() for _, c, _, _ in commands[105:118])
    assert commands[-1][1].succeeded, commands[-1][1].reason
    assert error_to(plant.T, displaced(goal.displacement))[0] < 0.3 * MM


def test_an_arm_that_falls_too_far_behind_fails_with_the_distance():
    plant = Plant(Plane(), START)
    plant.step = lambda twist: (
        setattr(plant, "now_ns", plant.now_ns + plant.period_ns),
        plant.history.append((plant.now_ns, plant.T.copy())),
    )
    _, commands = moved(
        TrajectoryGoal(displacement=(0.06, 0, 0, 0, 0, 0)), {"task__largest_error": 0.005}, plant=plant
    )
    last = commands[-1][1]
    assert last.phase == FAILED and not last.succeeded
    assert last.reason.startswith("the arm is 5.") and last.reason.endswith("mm off its trajectory")


def test_a_stop_comes_to_rest_and_fails_with_its_reason_and_finishing_ends_well():
    goal = TrajectoryGoal(displacement=(0.06, 0, 0, 0, 0, 0))
    for ask, phase, reason in (("stop", FAILED, "enough"), ("finish", DONE, "")):
        task = Trajectory(TrajectoryTaskSettings(), goal)
        asked = functools.partial(getattr(task, ask), *filter(None, [reason]))
        commands = run(task, Plant(Plane(), START), each=at_step(120, asked))
        assert phases_of(commands) == [MOVE, STOPPING, phase]
        assert (commands[-1][1].reason, commands[-1][1].succeeded) == (reason, phase == DONE)


def test_progress_never_goes_back():
    _, commands = moved(TrajectoryGoal(**OSCILLATION, period=6.0, periods=1.0))
    progress = [c.progress for _, c, _, _ in commands]
    assert progress == sorted(progress) and progress[0] < 0.01 and progress[-1] == 1.0


@pytest.mark.parametrize(
    "bad, message",
    [
        ({}, "there is nothing to move along"),
        ({"speed": 0.02}, "there is nothing to move along"),
        ({"amplitude": (0.01, 0, 0, 0, 0, 0), "periods": 0.0}, "there is nothing to move along"),
        ({"displacement": (0.1, 0, 0)}, "6 elements"),
        ({"displacement": (0.01, 0, 0, 0, 0, 0), "speed": 0.0}, "speed"),
        ({"amplitude": (float("nan"), 0, 0, 0, 0, 0)}, "amplitude"),
    ],
)
def test_a_goal_that_makes_no_sense_is_refused(bad, message):
    with pytest.raises(SettingError, match=message):
        TrajectoryGoal(**bad)
