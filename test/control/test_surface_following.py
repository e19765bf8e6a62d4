"""Surface following as a user sees it: whole runs on a small plant, and what happens when things go wrong."""

import dataclasses

import numpy as np
import pytest
from kinematic_plant import MS, Plane, Plant, Sphere, freeze_after, pointing_down, rest_after, run

from tactile_base.settings import SettingError
from tactile_control.contact_phases import APPROACH, LEAVE, SETTLE
from tactile_control.phases import (
    DONE,
    FAILED,
    GO_TO_START,
    RETREAT,
    StampedPose,
    StampedPresence,
    TaskInputs,
)
from tactile_control.task_file import load_controller
from tactile_control.tasks.surface_following import (
    FOLLOW,
    FollowingGoal,
    SurfaceFollowing,
    SurfaceFollowingSettings,
)

CONTROLLER = "config/controllers/surface_following.yaml"


@pytest.fixture
def settings(request):
    return load_controller(request.config.rootpath / CONTROLLER, SurfaceFollowingSettings())


def above(surface, height=0.024):
    return pointing_down(surface.top() + np.array([0.0, 0.0, height]))


def phases_of(commands):
    order = [command.phase for _, command, _, _ in commands]
    return [phase for k, phase in enumerate(order) if k == 0 or order[k - 1] != phase]


def following(commands, phase=FOLLOW):
    return [(c, depth, tilt) for _, c, depth, tilt in commands if c.phase == phase]


# ---- runs that go well ----


def test_a_plane_is_followed_at_depth_speed_and_length(settings):
    surface = Plane()
    task = SurfaceFollowing(settings, FollowingGoal(direction_deg=90.0, length=0.03))
    plant = Plant(surface, above(surface))
    commands = run(task, plant)
    assert phases_of(commands) == [APPROACH, SETTLE, FOLLOW, RETREAT, DONE]
    last = commands[-1][1]
    assert last.done and last.succeeded and last.reason == "" and last.progress == 1.0
    follow = following(commands)
    assert np.sqrt(np.mean([(d - 0.003) ** 2 for _, d, _ in follow])) < 0.0003
    assert last.travelled == pytest.approx(0.03, abs=0.0005)
    assert plant.T[1, 3] > 0.029 and abs(plant.T[0, 3]) < 1e-4
    assert plant.depth < -0.009  # retreated


def test_progress_never_goes_back(settings):
    surface = Plane()
    commands = run(SurfaceFollowing(settings, FollowingGoal(length=0.02)), Plant(surface, above(surface)))
    progress = [c.progress for _, c, _, _ in commands]
    assert progress == sorted(progress) and progress[-1] == 1.0


def test_feedforward_comes_in_smoothly(settings):
    surface = Plane()
    commands = run(SurfaceFollowing(settings, FollowingGoal(length=0.02)), Plant(surface, above(surface)))
    speeds = np.array([np.linalg.norm(c.feedforward[:3]) for c, _, _ in following(commands)])
    assert speeds[0] < 0.001 and speeds.max() == pytest.approx(0.010, rel=1e-6)
    assert np.diff(speeds).max() < 0.0010


@pytest.mark.parametrize("k", range(8))
def test_the_eight_radial_paths_of_a_dome_keep_depth(settings, k):
    surface, direction = Sphere(0.075), k * np.pi / 4
    plant = Plant(surface, above(surface))
    commands = run(
        SurfaceFollowing(settings, FollowingGoal(direction_deg=np.degrees(direction), length=0.04)), plant
    )
    assert commands[-1][1].succeeded
    follow = following(commands)
    assert np.sqrt(np.mean([(d - 0.003) ** 2 for _, d, _ in follow])) < 0.0003
    heading = plant.T[:2, 3] / np.linalg.norm(plant.T[:2, 3])
    expected = [-np.cos(direction), np.sin(direction)]  # the sensor's x points along the base's -x
    np.testing.assert_allclose(heading, expected, atol=0.03)


def test_steady_tilt_on_a_sphere_is_turning_rate_over_gain(settings):
    """What proportional feedback alone leaves: v / (path radius * Kp)."""
    surface = Sphere(0.075)
    settings = settings.replaced(pid__ki=[0.0] * 6, pid__kd=[0.0] * 6)
    commands = run(
        SurfaceFollowing(settings, FollowingGoal(length=0.06)), Plant(surface, above(surface), delay_steps=0)
    )
    tilt = np.mean([t for c, _, t in following(commands)][-60:])
    assert tilt == pytest.approx(0.010 / (0.092 * 2.0), rel=0.03)


def test_curvature_fed_forward_removes_the_tilt(settings):
    surface = Sphere(0.075)
    settings = settings.replaced(task__curvature=1.0 / 0.092)
    commands = run(SurfaceFollowing(settings, FollowingGoal(length=0.06)), Plant(surface, above(surface)))
    assert np.degrees(np.max([t for c, _, t in following(commands)])) < 0.5


def test_the_way_to_the_start_goes_up_across_and_down(settings):
    surface = Plane()
    start = above(surface)
    away = start.copy()
    away[:3, 3] += [0.05, -0.04, -0.002]
    away[:3, :3] = away[:3, :3] @ np.array(
        [[1, 0, 0], [0, np.cos(0.4), -np.sin(0.4)], [0, np.sin(0.4), np.cos(0.4)]]
    )
    plant = Plant(surface, away)
    path = []
    task = SurfaceFollowing(settings, FollowingGoal(length=0.01), start)
    commands = run(task, plant, each=lambda k, c: path.append((c.phase, plant.T.copy())))
    assert phases_of(commands)[0] == GO_TO_START and commands[-1][1].succeeded
    way = np.array([T for phase, T in path if phase == GO_TO_START])
    sideways = np.linalg.norm(way[:, :2, 3] - way[0, :2, 3], axis=1)
    across = (sideways > 0.003) & (sideways < 0.06)
    assert across.any() and (way[across, 2, 3] > start[2, 3] + 0.015).all()
    approach = next(T for phase, T in path if phase == APPROACH)
    np.testing.assert_allclose(approach, start, atol=0.006)


def test_a_target_ends_the_path(settings):
    surface = Plane()
    goal = FollowingGoal(length=0.1, target=(0.0, 0.02, 0.017), target_radius=0.002)
    plant = Plant(surface, above(surface))
    commands = run(SurfaceFollowing(settings, goal), plant)
    assert commands[-1][1].succeeded and 0.017 < commands[-1][1].travelled < 0.021


def test_new_gains_in_mid_run_do_not_make_the_twist_jump(settings):
    surface = Sphere(0.075)
    task = SurfaceFollowing(settings, FollowingGoal(length=0.04))
    at = []

    def retune(k, command):
        if command.phase == FOLLOW and command.travelled > 0.02 and not at:
            at.append(k)
            task.configure(settings.replaced(pid__kp=[0, 0, 5, 5, 5, 0], pid__ki=[0, 0, 2, 2, 2, 0]))

    commands = run(task, Plant(surface, above(surface)), each=retune)
    twists = np.array([c.twist for _, c, _, _ in commands])
    jump = np.abs(twists[at[0] + 1] - twists[at[0]])
    assert commands[-1][1].succeeded and jump[:3].max() < 5e-4 and jump[3:].max() < 0.02


def test_the_same_run_gives_the_same_bits(settings):
    surface = Sphere(0.075)
    runs = [
        run(SurfaceFollowing(settings, FollowingGoal(length=0.01)), Plant(surface, above(surface), seed=3))
        for _ in range(2)
    ]
    for (_, a, _, _), (_, b, _, _) in zip(*runs, strict=True):
        np.testing.assert_array_equal(a.twist, b.twist)


# ---- faults ----


@pytest.mark.parametrize(
    "names, expected",
    [
        (("presence",), "presence is"),
        (("sensor_pose",), "pose is"),
        (("belief", "presence"), "presence is"),
    ],
)
def test_a_silent_input_stops_the_arm_within_200_ms_and_is_named(settings, names, expected):
    surface, at_ns = Plane(), 5 * 10**9
    plant = Plant(surface, above(surface), delay_steps=0)
    commands = run(
        SurfaceFollowing(settings, FollowingGoal(length=0.1)), plant, change=freeze_after(names, at_ns)
    )
    last = commands[-1][1]
    assert last.done and not last.succeeded and last.phase == FAILED
    assert expected in last.reason and "limit 100 ms" in last.reason
    speed_before = max(np.abs(c.twist).max() for now, c, _, _ in commands if now < at_ns)
    assert speed_before > 0.005
    assert rest_after(commands, at_ns) <= 200.0
    ended_ns = next(now for now, c, _, _ in commands if c.phase == FAILED)
    assert ended_ns - at_ns >= settings.watchdog.patience * 1000 * MS


def test_a_silence_longer_than_the_ramp_brings_the_arm_to_rest_and_the_task_goes_on(settings):
    surface = Plane()

    def change(k, inputs):
        if 300 <= k < 340:
            return held[0]
        held[:] = [inputs]
        return inputs

    held = []
    task = SurfaceFollowing(settings, FollowingGoal(length=0.05))
    commands = run(task, Plant(surface, above(surface)), change=change)
    assert any(c.phase == FOLLOW and not c.twist.any() for _, c, _, _ in commands[300:340])
    assert commands[-1][1].succeeded


def test_a_short_silence_is_ridden_out(settings):
    surface = Plane()

    def change(k, inputs):
        if 300 <= k < 308:
            return held[0]
        held[:] = [inputs]
        return inputs

    held = []
    commands = run(
        SurfaceFollowing(settings, FollowingGoal(length=0.05)), Plant(surface, above(surface)), change=change
    )
    assert commands[-1][1].succeeded
    assert any("old, limit" in c.reason for _, c, _, _ in commands[300:312])


@pytest.mark.parametrize("what", ["belief", "sensor_pose"])
def test_not_a_number_counts_as_nothing_arrived_and_is_said(settings, what):
    surface = Plane()

    def change(k, inputs):
        good = getattr(inputs, what)
        if k < 300 or good is None:
            return inputs
        return dataclasses.replace(inputs, **{what: StampedPose(good.stamp_ns, np.full((4, 4), np.nan))})

    commands = run(
        SurfaceFollowing(settings, FollowingGoal(length=0.1)), Plant(surface, above(surface)), change=change
    )
    assert commands[-1][1].phase == FAILED and "is not finite" in commands[-1][1].reason
    assert all(np.isfinite(c.twist).all() for _, c, _, _ in commands)


def test_inputs_that_never_come_fail_by_name(settings):
    plant = Plant(Plane(), above(Plane()))
    commands = run(SurfaceFollowing(settings, FollowingGoal()), plant, change=lambda k, inputs: TaskInputs())
    last = commands[-1]
    assert last[1].phase == FAILED and "no pose and no presence has arrived within 10 s" in last[1].reason
    assert not any(c.twist.any() for _, c, _, _ in commands)


def test_no_surface_within_reach_fails_with_the_distance(settings):
    settings = settings.replaced(contact__approach_distance=0.01)
    surface = Plane()
    commands = run(SurfaceFollowing(settings, FollowingGoal()), Plant(surface, above(surface, 0.05)))
    assert phases_of(commands)[-2:] == [RETREAT, FAILED]
    assert commands[-1][1].reason == "no contact within 10.0 mm of approach"


def test_a_path_that_takes_too_long_fails(settings):
    settings = settings.replaced(task__timeout=1.0)
    surface = Plane()
    commands = run(SurfaceFollowing(settings, FollowingGoal(length=0.1)), Plant(surface, above(surface)))
    assert commands[-1][1].reason == "the path was not done within 1 s"


def test_a_target_that_is_not_on_the_path_fails(settings):
    surface = Plane()
    goal = FollowingGoal(length=0.02, target=(0.05, 0.0, 0.017))
    commands = run(SurfaceFollowing(settings, goal), Plant(surface, above(surface)))
    assert commands[-1][1].reason == "the target was not reached within 20.0 mm of path"


def losing_contact(times):
    """Presence says no contact for 0.3 s, `times` times, while following; beliefs go on."""
    starts = [400 + 250 * i for i in range(times)]

    def change(k, inputs):
        if any(s <= k < s + 18 for s in starts):
            return dataclasses.replace(
                inputs, presence=dataclasses.replace(inputs.presence, in_contact=False)
            )
        return inputs

    return change


def test_lost_contact_is_approached_again_and_the_path_goes_on(settings):
    surface = Plane()
    commands = run(
        SurfaceFollowing(settings, FollowingGoal(length=0.04)),
        Plant(surface, above(surface)),
        change=losing_contact(1),
    )
    assert phases_of(commands) == [APPROACH, SETTLE, FOLLOW, APPROACH, SETTLE, FOLLOW, RETREAT, DONE]
    assert commands[-1][1].succeeded


def test_an_edge_that_the_sensor_slides_over_is_lost_contact_not_a_silent_input(settings):
    """Without contact there are no beliefs either."""

    class Edge(Plane):
        def query(self, p):
            distance, normal = super().query(p)
            return distance + (0.03 if p[1] > 0.01 else 0.0), normal

    settings = settings.replaced(contact__lost_contact="fail")
    plant = Plant(Edge(), above(Plane()))
    commands = run(SurfaceFollowing(settings, FollowingGoal(length=0.04)), plant)
    assert phases_of(commands)[-2:] == [RETREAT, FAILED]
    assert commands[-1][1].reason == "contact was lost in phase follow"


def test_lost_contact_fails_where_the_settings_say_so(settings):
    surface = Plane()
    settings = settings.replaced(contact__lost_contact="fail")
    commands = run(
        SurfaceFollowing(settings, FollowingGoal(length=0.04)),
        Plant(surface, above(surface)),
        change=losing_contact(1),
    )
    assert phases_of(commands)[-2:] == [RETREAT, FAILED]
    assert commands[-1][1].reason == "contact was lost in phase follow"


def test_contact_lost_too_often_fails(settings):
    surface = Plane()
    settings = settings.replaced(contact__reapproaches=1)
    commands = run(
        SurfaceFollowing(settings, FollowingGoal(length=0.1)),
        Plant(surface, above(surface)),
        change=losing_contact(2),
    )
    assert commands[-1][1].reason == "contact was lost 2 times"


def test_a_stop_decelerates_retreats_and_gives_its_reason(settings):
    surface = Plane()
    task = SurfaceFollowing(settings, FollowingGoal(length=0.1))
    plant = Plant(surface, above(surface))
    commands = run(task, plant, each=lambda k, c: task.stop("Ctrl-C") if c.travelled > 0.02 else None)
    last = commands[-1][1]
    assert phases_of(commands)[-3:] == ["stopping", RETREAT, FAILED]
    assert last.done and not last.succeeded and last.reason == "Ctrl-C" and plant.depth < -0.009


def test_a_retreat_that_takes_too_long_is_told_beside_the_reason_for_it(settings):
    surface = Plane()
    task = SurfaceFollowing(settings.replaced(contact__retreat_timeout=0.1), FollowingGoal(length=0.1))
    commands = run(
        task,
        Plant(surface, above(surface)),
        each=lambda k, c: task.stop("Ctrl-C") if c.travelled > 0.002 else None,
    )
    assert phases_of(commands)[-3:] == ["stopping", RETREAT, FAILED]
    assert commands[-1][1].reason == "Ctrl-C; the retreat took longer than 0.1 s"


def test_a_stop_in_the_air_stays_there(settings):
    surface = Plane()
    task = SurfaceFollowing(settings, FollowingGoal(), above(surface, 0.1))
    commands = run(
        task, Plant(surface, above(surface, 0.2)), each=lambda k, c: task.stop("enough") if k == 30 else None
    )
    assert phases_of(commands) == [GO_TO_START, "stopping", FAILED]


def test_touching_something_on_the_way_to_the_start_backs_off_and_fails(settings):
    surface = Plane()
    plant = Plant(surface, above(surface, 0.03))
    commands = run(SurfaceFollowing(settings, FollowingGoal(), above(surface, 0.0175)), plant)
    assert commands[-1][1].reason == "touched something on the way to the start"
    assert plant.depth < -0.005


def test_a_clock_that_goes_back_fails_in_place(settings):
    surface = Plane()
    task = SurfaceFollowing(settings, FollowingGoal())
    plant = Plant(surface, above(surface))
    run(task, plant, limit_s=2.0)
    command = task.step(plant.now_ns - 3 * 10**9, plant.inputs())
    assert command.phase == FAILED and "the clock went back by" in command.reason


@pytest.mark.parametrize("start", [True, False], ids=["with a start", "where it stands"])
def test_a_task_that_begins_in_contact_leaves_the_surface_first(settings, start):
    surface = Plane()
    plant = Plant(surface, above(surface, 0.017))
    task = SurfaceFollowing(settings, FollowingGoal(length=0.01), above(surface, 0.03) if start else None)
    commands = run(task, plant)
    expected = [LEAVE, GO_TO_START, APPROACH] if start else [LEAVE, APPROACH]
    assert phases_of(commands)[: len(expected)] == expected
    leaving = [entry[1] for entry in commands if entry[1].phase == LEAVE]
    assert all(command.twist[2] <= 0.0 and not command.twist[:2].any() for command in leaving)
    assert commands[-1][1].succeeded


def test_a_task_that_begins_in_a_contact_that_it_cannot_leave_fails_and_says_so(settings):
    surface = Plane()
    plant = Plant(surface, above(surface, -0.1))
    commands = run(SurfaceFollowing(settings, FollowingGoal(), above(surface, 0.1)), plant)
    assert "still in contact after backing off by 45." in commands[-1][1].reason


def test_the_approach_goes_on_for_the_press_distance(settings):
    surface = Plane()
    for press in (0.0, 0.001):
        task = SurfaceFollowing(settings.replaced(contact__press_distance=press), FollowingGoal(length=0.01))
        commands = run(task, Plant(surface, above(surface), delay_steps=0))
        begin = next(depth for _, c, depth, _ in commands if c.phase == SETTLE)
        assert begin == pytest.approx(0.0004 + press, abs=0.0002)


def test_a_touch_that_goes_away_while_pressing_was_none(settings):
    task = SurfaceFollowing(settings, FollowingGoal())
    plant = Plant(Plane(), above(Plane(), 0.1))

    def change(k, inputs):
        return dataclasses.replace(inputs, presence=StampedPresence(inputs.presence.stamp_ns, 20 <= k < 24))

    commands = run(task, plant, limit_s=2.0, change=change)
    assert phases_of(commands) == [APPROACH]


def test_the_belief_from_before_the_contact_is_not_acted_upon(settings):
    task, now = SurfaceFollowing(settings.replaced(contact__press_distance=0.0), FollowingGoal()), 10**9
    old = StampedPose(now - 5 * MS, np.eye(4))
    for k in range(3):
        stamp = now + k * 16 * MS
        command = task.step(
            stamp, TaskInputs(old, StampedPresence(stamp, k > 0), StampedPose(stamp, np.eye(4)))
        )
    assert command.phase == SETTLE and np.isnan(command.error).all() and not command.unlimited.any()


# ---- goals and settings ----


@pytest.mark.parametrize(
    "bad",
    [{"length": 0.0}, {"length": float("nan")}, {"direction_deg": float("inf")}, {"target": (0.0, 0.0)}],
)
def test_a_goal_that_makes_no_sense_is_refused(bad):
    with pytest.raises(ValueError):
        FollowingGoal(**bad)


def test_an_unknown_setting_names_its_group_and_the_nearest():
    with pytest.raises(SettingError, match=r"did you mean 'speed'"):
        SurfaceFollowingSettings().replaced(task__sped=0.01)
    with pytest.raises(SettingError, match=r"unknown name 'pdi'.*did you mean 'pid'"):
        SurfaceFollowingSettings.from_mapping({"pdi": {}})


def test_a_run_that_goes_well_gives_no_reasons_but_says_what_was_limited(settings):
    surface = Plane()
    commands = run(SurfaceFollowing(settings, FollowingGoal(length=0.02)), Plant(surface, above(surface)))
    assert {c.reason for _, c, _, _ in commands} == {""}
    assert any("linear acceleration" in c.limited for c, _, _ in following(commands, RETREAT))
