"""Pushing on a small plant (the paper's appendix): to the target, and every reason not to."""

import dataclasses
import re

import numpy as np
import pytest
from kinematic_plant import PushedFace, PushingPlant, freeze_after, rest_after, run
from test_alignment import TARGET, pushing_along_y

from tactile_base.settings import SettingError
from tactile_control.contact_phases import APPROACH, SETTLE
from tactile_control.phases import DONE, FAILED, RETREAT, STOPPING, StampedPresence
from tactile_control.task_file import load_controller, load_task
from tactile_control.tasks.object_tracking import ObjectTrackingSettings
from tactile_control.tasks.pushing import PUSH, Pushing, PushingGoal, PushingSettings

CONTROLLERS = "config/controllers"
TURNING = 12.0  # rad/m: alpha / r0 of a square of 80 mm, about


@pytest.fixture
def controllers(request):
    return request.config.rootpath / CONTROLLERS


@pytest.fixture
def settings(controllers):
    return load_controller(controllers / "pushing.yaml", PushingSettings())


def plant_with(gap=0.005, turning=TURNING, **face):
    T = pushing_along_y()
    contact = T[:3, 3] + (0.020 + gap) * T[:3, 2]
    return PushingPlant(PushedFace(contact, T[:3, 2], turning, **face), T)


def phases_of(commands):
    order = [command.phase for _, command, _, _ in commands]
    return [phase for k, phase in enumerate(order) if k == 0 or order[k - 1] != phase]


def target_error(surface):
    """Distance (m) of the target from the line through the contact along its normal."""
    away = np.array(TARGET) - surface.contact
    return float(np.linalg.norm(away - (away @ surface.normal) * surface.normal))


def pushed(settings, plant, target=TARGET, start=None, **more):
    task = Pushing(settings, PushingGoal(target=target), start)
    return task, run(task, plant, **more)


# ---- the way to the target ----


def test_an_object_is_pushed_to_the_target_and_left_there(settings):
    plant = plant_with()
    _, commands = pushed(settings, plant, start=pushing_along_y())
    assert phases_of(commands) == [APPROACH, SETTLE, PUSH, RETREAT, DONE]
    assert commands[-1][1].succeeded and target_error(plant.surface) < 0.005
    push = [c for _, c, _, _ in commands if c.phase == PUSH]
    assert np.all(np.diff([c.progress for c in push]) >= 0.0) and push[-1].progress > 0.95


def test_the_push_ends_when_the_sensors_centre_is_nearer_to_the_target_than_its_radius(settings):
    plant, distances = plant_with(), []
    pushed(
        settings,
        plant,
        each=lambda k, c: distances.append((c.phase, np.linalg.norm(plant.T[:3, 3] - TARGET))),
    )
    last = [distance for phase, distance in distances if phase == PUSH][-1]
    first = next(distance for phase, distance in distances if phase == RETREAT)
    assert first < 0.020 <= last


def test_the_sensor_moves_at_the_papers_10_mm_per_second_into_the_surface(settings):
    _, commands = pushed(settings, plant_with())
    straight = [np.linalg.norm(c.feedforward) for _, c, _, _ in commands if c.phase == PUSH][-60:]
    np.testing.assert_allclose(straight, 0.010)


def test_with_the_gains_read_in_radians_the_target_is_missed(settings):
    """0.9 mm/s for a radian, as the paper's table could be read, does not turn the object round."""
    small = settings.replaced(alignment__kp=0.9 / 57.3, alignment__ki=0.3 / 57.3, alignment__kd=0.9 / 57.3)
    _, commands = pushed(small, plant_with())
    assert "cannot be reached any more" in commands[-1][1].reason


def test_an_object_that_cannot_be_steered_fails_and_says_by_how_much_the_target_was_missed(settings):
    _, commands = pushed(settings, plant_with(turning=0.0))
    assert phases_of(commands)[-3:] == [STOPPING, RETREAT, FAILED]
    reason = commands[-1][1].reason
    assert "the target was passed" in reason and "friction" not in reason


def test_of_an_object_that_turns_as_it_goes_ahead_the_failure_says_why_and_what_makes_up_for_it(settings):
    _, commands = pushed(settings, plant_with(drift=5.0))
    assert re.search(
        r"the target was passed .*; it turns by (2\.[5-9]|3\.[0-2]) deg for each 10 mm ahead: its "
        r"friction is centred beside the contact, which steering makes up for \(controller pushing_tuned\)",
        commands[-1][1].reason,
    )


# ---- contact ----


def test_settling_does_not_wait_for_a_depth_that_has_no_gain(settings):
    plant = plant_with(depth=0.0015)
    _, commands = pushed(settings, plant)
    settling = [now for now, c, _, _ in commands if c.phase == SETTLE]
    assert (settling[-1] - settling[0]) * 1e-9 < 0.5
    assert settings.servoing.reference[2] == 0.0 and settings.contact.settle_depth_tolerance < 0.0015


def test_the_object_hardly_moves_before_the_push(settings):
    plant = plant_with(depth=0.0008)
    contact = plant.surface.contact.copy()
    task = Pushing(settings, PushingGoal(target=TARGET))
    run(task, plant, each=lambda k, c: task.finish() if c.phase == PUSH else None)
    assert np.linalg.norm(plant.surface.contact - contact) < 0.001


def test_a_push_that_begins_in_contact_settles_at_once(settings):
    plant = plant_with(gap=-0.001)
    _, commands = pushed(settings, plant, start=pushing_along_y())
    assert phases_of(commands)[0] == SETTLE and commands[-1][1].succeeded


def test_a_lost_contact_ends_the_push_and_says_so(settings):
    def change(k, inputs):
        lost = k > 600
        presence = StampedPresence(inputs.presence.stamp_ns, inputs.presence.in_contact and not lost)
        return dataclasses.replace(inputs, presence=presence, belief=None if lost else inputs.belief)

    _, commands = pushed(settings, plant_with(), change=change)
    assert phases_of(commands)[-4:] == [PUSH, STOPPING, RETREAT, FAILED]
    assert commands[-1][1].reason == "contact was lost in phase push"


# ---- inputs that stop ----


@pytest.mark.parametrize(
    "names, expected",
    [(("presence",), "presence is"), (("sensor_pose",), "pose is")],
)
@pytest.mark.parametrize("controller", ["pushing.yaml", "pushing_tuned.yaml", "pushing_offset.yaml"])
def test_a_silent_input_brings_the_push_to_rest_within_200_ms_and_is_named(
    controllers, controller, names, expected
):
    settings, at_ns = load_controller(controllers / controller, PushingSettings()), 15 * 10**9
    _, commands = pushed(settings, plant_with(), change=freeze_after(names, at_ns))
    pushing = [np.abs(c.twist).max() for now, c, _, _ in commands if now < at_ns and c.phase == PUSH]
    assert pushing[-1] > 0.005
    assert rest_after(commands, at_ns) <= 200.0
    last = commands[-1][1]
    assert last.phase == FAILED and expected in last.reason and "limit 100 ms" in last.reason


# ---- targets that cannot be reached ----


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ((0.1, -0.35, 0.045), r"the target lies behind the sensor \(bearing 180 deg\)"),
        ((0.1, -0.24, 0.045), r"10\.0 mm from the sensor's centre, nearer than its radius of 20 mm"),
        ((0.375, 0.0, 0.145), r"lies 100\.0 mm above the plane in which the sensor pushes"),
        ((0.375, 0.0, 0.0), r"lies 45\.0 mm below the plane"),
        ((0.1, 4.0, 0.045), r"at 10 mm/s 423 s, over task\.timeout \(180 s\)"),
    ],
)
@pytest.mark.parametrize("start", [None, pushing_along_y()], ids=["where it stands", "with a start"])
def test_a_target_that_cannot_be_reached_is_refused_before_anything_moves(settings, target, reason, start):
    plant = plant_with(gap=-0.001)
    _, commands = pushed(settings, plant, target=target, start=start)
    assert len(commands) == 1 and commands[0][1].phase == FAILED and not commands[0][1].twist.any()
    assert re.search(reason, commands[0][1].reason)


def test_a_target_in_the_world_is_refused_by_who_does_not_know_where_the_base_stands(settings):
    task = Pushing(settings, PushingGoal(target=TARGET, frame="world"))
    command = run(task, plant_with())[-1][1]
    assert command.phase == FAILED and "give it in frame base" in command.reason


def test_a_target_in_the_world_is_the_same_one_in_the_base():
    T_world_base = np.eye(4)
    T_world_base[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    T_world_base[:3, 3] = [0.5, 0.1, 0.2]
    goal = PushingGoal(target=TARGET, frame="world").in_base(T_world_base)
    assert goal.frame == "base"
    np.testing.assert_allclose(T_world_base @ [*goal.target, 1.0], [*TARGET, 1.0])
    assert goal.in_base(T_world_base) == goal


@pytest.mark.parametrize("bad", [{}, {"target": (0.1, 0.2)}, {"target": TARGET, "frame": "tool"}])
def test_a_goal_that_makes_no_sense_is_refused(bad):
    with pytest.raises(SettingError):
        PushingGoal(**bad)


# ---- the paper's tables ----


def test_pushing_holds_the_papers_table(settings):
    assert settings.pid.kp == (1, 0, 0, 1, 0, 0)
    assert settings.pid.ki == settings.pid.kd == (0.1, 0, 0, 0.1, 0, 0)
    assert settings.pid.integral_limit == (0.025, 0.025, 0.025, 25, 25, 25)
    assert settings.servoing.reference == (0.0,) * 6
    align = settings.alignment
    assert (align.kp, align.ki, align.kd) == (0.9, 0.3, 0.9)
    assert (align.integral_limit_deg_s, align.output_limit_mm_s, align.cutoff_distance) == (10, 15, 0.12)
    assert settings.task.speed == 0.010 and settings.contact.lost_contact == "fail"


def test_the_followers_table(controllers):
    follower = load_controller(controllers / "pushing_follower.yaml", ObjectTrackingSettings())
    assert follower.pid.kp == (5, 0, 5, 1, 0, 0)
    assert follower.pid.ki == follower.pid.kd == (0.5, 0, 0.5, 0.1, 0, 0)
    assert follower.pid.integral_limit == (0.2, 0.2, 0.2, 200, 200, 200)
    assert follower.servoing.reference == (0, 0, 0.003, 0, 0, 0)


def test_our_tuning_steers_in_place_of_target_alignment_and_keeps_the_rest(controllers, settings):
    tuned = load_controller(controllers / "pushing_tuned.yaml", PushingSettings())
    assert tuned.steering.enabled and not settings.steering.enabled
    assert (tuned.pid, tuned.task) == (settings.pid, settings.task)
    assert tuned.servoing.reference == settings.servoing.reference


@pytest.mark.parametrize("controller", [None, "leader=pushing_tuned"])
@pytest.mark.parametrize("scene", ["dual_pushing", "dual_pushing_tall"])
def test_of_two_arms_the_leader_waits_for_the_follower_and_has_the_papers_settings(
    scene, controller, controllers
):
    task = load_task(controllers.parent / "tasks" / "dual_pushing.yaml", scene, controller=controller)
    leader = task.role("leader")
    assert leader.after == ("follower", "track") and leader.ends_run and leader.settings.alignment.ki == 0.5
    tall = 0.0005 if scene == "dual_pushing_tall" else 0.0
    assert leader.settings.servoing.reference[0] == tall
    assert task.role("follower").settings.servoing.reference == (-tall, 0, 0.003, 0, 0, 0)


# ---- no deeper than is allowed ----


def test_a_push_goes_slower_at_a_depth_that_comes_near_to_the_limit_and_back_beyond_it():
    pace = PushingSettings().task.pace
    assert [pace(depth) for depth in (0.0, 0.003, 0.0055)] == pytest.approx([1.0, 1.0, 1.0])
    assert [pace(depth) for depth in (0.0057, 0.0059, 0.006, 0.02)] == pytest.approx([0.5, 0.0, -0.25, -0.5])
    with pytest.raises(SettingError, match=r"stop_depth: must be more than slow_depth \(0.0055 m\)"):
        PushingSettings().replaced(task__stop_depth=0.005)


def test_an_object_that_does_not_go_on_is_pressed_no_deeper_and_the_push_fails(settings):
    """As one that has come to a wall."""
    plant, depths = plant_with(depth=0.05), []
    _, commands = pushed(settings, plant, each=lambda k, command: depths.append(plant.depth))
    last = commands[-1][1]
    assert last.phase == FAILED and "the object has not gone on for 2.0 s" in last.reason
    assert 0.0055 < max(depths) < 0.006 and plant.depth < 0.0
