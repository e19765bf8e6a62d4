"""The order of a run: who starts when, what waits for whose phase, and when all are told to finish."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from tactile_base.settings import SettingError
from tactile_bringup.run_sequence import RunSequence, arm_plans
from tactile_control.task_file import load_task
from tactile_scene.scene_file import load_scene

LEADER = {"task": "trajectory"}
FOLLOWER = {"task": "object_tracking"}
MOVE = {"displacement": [0.02, 0, 0, 0, 0, 0]}


@pytest.fixture
def planned(tmp_path: Path):
    """Plans of a task of roles on a scene with a mover without and two feelers with a sensor."""

    def make(roles: dict, on_scene: dict, base=None, **chosen):
        start = {"start": {"position": [0, 0, 0.1]}, "base": base or {}}
        feels = start | {"sensor": {}}
        scene, task = tmp_path / "shelf.yaml", tmp_path / "carry.yaml"
        scene.write_text(
            yaml.safe_dump({"arms": {"mover": start, "left": feels, "right": feels}}, sort_keys=False)
        )
        task.write_text(yaml.safe_dump({"roles": roles, "scenes": {"shelf": on_scene}}, sort_keys=False))
        return arm_plans(load_task(task, "shelf"), load_scene(scene), **chosen)

    return make


@pytest.fixture
def tracking(planned):
    """A leader that moves twice when its two followers track, and whose end ends the run."""
    lead = {"arms": ["mover"], "after": {"follower": "track"}, "ends_run": True}
    lead["goals"] = [MOVE | {"name": "there"}, MOVE | {"name": "on"}]
    follow = {"goals": [{"name": "hold"}]}
    return RunSequence(
        planned({"leader": LEADER, "follower": FOLLOWER}, {"leader": lead, "follower": follow})
    )


def started(sequence: RunSequence) -> list[tuple[str, str]]:
    return [(plan.arm, plan.goals[goal].name) for plan, goal in sequence.start()]


# ---- who does what ----


def test_a_role_without_arms_is_that_of_every_arm_that_can_run_its_task(planned):
    plans = planned({"follower": FOLLOWER}, {"follower": {"goals": [{"name": "hold"}]}})
    assert [plan.arm for plan in plans] == ["left", "right"]


def test_two_roles_for_one_arm_are_refused(planned):
    on_scene = {
        "leader": {"arms": ["mover", "left"], "goals": [MOVE]},
        "follower": {"arms": ["left"], "goals": [{}]},
    }
    with pytest.raises(SettingError, match="arm 'left' has two roles, leader and follower"):
        planned({"leader": LEADER, "follower": FOLLOWER}, on_scene)


@pytest.mark.parametrize(
    "arm, message",
    [
        ("mover", "role follower: arm 'mover' has no tactile sensor; valid: left, right"),
        ("lefft", "role follower: arm 'lefft' is not in the scene; valid: left, right"),
    ],
)
def test_an_arm_that_cannot_run_its_task_is_refused(planned, arm, message):
    with pytest.raises(SettingError, match=message):
        planned({"follower": FOLLOWER}, {"follower": {"arms": [arm], "goals": [{}]}})


def test_a_goal_in_the_world_arrives_in_the_arms_base(planned):
    plans = planned(
        {"pusher": {"task": "pushing"}},
        {"pusher": {"arms": ["left"], "goals": [{"target": [0.3, 0.2, 0.1], "frame": "world"}]}},
        base={"position": [0.1, 0.0, 0.0], "rotation_deg": [0, 0, 90]},
    )
    (goal,) = plans[0].goals
    assert goal.goal.frame == "base"
    np.testing.assert_allclose(goal.goal.target, [0.2, -0.2, 0.1], atol=1e-12)


def test_an_arm_with_a_sensor_may_do_what_needs_none(planned):
    plans = planned({"leader": LEADER}, {"leader": {"arms": ["left"], "goals": [MOVE]}})
    assert [plan.arm for plan in plans] == ["left"]


def test_goals_in_contact_begin_where_the_arm_starts_and_those_of_a_move_where_the_last_one_ended(planned):
    elsewhere = [0.1, 0.0, 0.2, 0.0, 0.0, 0.0]
    on_scene = {
        "leader": {"arms": ["mover"], "goals": [MOVE, MOVE, MOVE | {"start": elsewhere}]},
        "follower": {"arms": ["left"], "goals": [{}, {"start": elsewhere}]},
    }
    mover, left = planned({"leader": LEADER, "follower": FOLLOWER}, on_scene)
    heights = [None if goal.start is None else goal.start[2, 3] for goal in mover.goals]
    np.testing.assert_allclose([heights[0], heights[2]], [0.1, 0.2])
    assert heights[1] is None
    np.testing.assert_allclose([goal.start[2, 3] for goal in left.goals], [0.1, 0.2])


def test_one_arm_and_some_goals_can_be_chosen(planned):
    roles, goals = {"follower": FOLLOWER}, [{"name": "first"}, {"name": "second"}]
    (plan,) = planned(roles, {"follower": {"goals": goals}}, only="right", goals=["second"])
    assert (plan.arm, [goal.name for goal in plan.goals]) == ("right", ["second"])
    with pytest.raises(SettingError, match="goal 'third' does not exist; valid: first, second"):
        planned(roles, {"follower": {"goals": goals}}, goals=["third"])
    with pytest.raises(SettingError, match="--arm mover: no arm to run it, of left, right"):
        planned(roles, {"follower": {"goals": goals}}, only="mover")


# ---- when ----


def test_goals_of_an_arm_run_one_after_the_other(planned):
    goals = [MOVE | {"name": "there"}, MOVE | {"name": "on"}]
    sequence = RunSequence(planned({"leader": LEADER}, {"leader": {"arms": ["mover"], "goals": goals}}))
    assert started(sequence) == [("mover", "there")]
    assert started(sequence) == [] and sequence.running("mover")
    assert sequence.result("mover", True, "")
    assert started(sequence) == [("mover", "on")]
    sequence.result("mover", True, "")
    assert sequence.finished and sequence.failure == "" and started(sequence) == []


def test_a_role_waits_until_every_arm_of_another_has_reached_a_phase(tracking):
    assert started(tracking) == [("left", "hold"), ("right", "hold")]
    for arm, phase in (("left", "approach"), ("right", "settle"), ("left", "track")):
        tracking.phase(arm, phase)
        assert started(tracking) == []
    tracking.phase("right", "track")
    assert started(tracking) == [("mover", "there")]


def test_when_the_role_that_ends_the_run_is_through_the_others_are_told_once_to_finish(tracking):
    started(tracking)
    for arm in ("left", "right"):
        tracking.phase(arm, "track")
    for _ in range(2):
        assert len(started(tracking)) == 1 and tracking.finish() == []
        tracking.result("mover", True, "")
    assert tracking.over and not tracking.finished
    assert tracking.finish() == ["left", "right"] and tracking.finish() == []
    assert tracking.result("left", True, "")
    assert not tracking.finished
    assert tracking.result("right", False, "cancelled"), "it was asked to"
    assert tracking.finished and tracking.failure == ""


def test_a_failure_ends_the_run_for_all_and_is_told_with_arm_and_goal(tracking):
    started(tracking)
    assert not tracking.result("left", False, "contact was lost in phase track")
    assert tracking.failure == "left: hold: contact was lost in phase track"
    assert started(tracking) == [] and tracking.finish() == ["right"]
    tracking.result("right", False, "the run has failed")
    assert tracking.finished and tracking.failure == "left: hold: contact was lost in phase track"


def test_the_others_finish_as_soon_as_an_arm_stops_unasked_and_need_not_wait_for_its_end(tracking):
    started(tracking)
    tracking.phase("left", "track")
    assert tracking.finish() == []
    tracking.phase("left", "stopping")
    assert tracking.finish() == ["right"] and tracking.finish() == [] and started(tracking) == []
    tracking.phase("right", "stopping")
    assert tracking.result("right", True, "")
    assert not tracking.finished
    assert not tracking.result("left", False, "contact was lost in phase track"), "nobody asked it to stop"
    assert tracking.finished and tracking.failure == "left: hold: contact was lost in phase track"


def test_without_a_role_that_ends_the_run_tasks_that_end_by_themselves_do(planned):
    on_scene = {
        "leader": {"arms": ["mover"], "goals": [MOVE]},
        "follower": {"arms": ["left"], "goals": [{"name": "hold"}]},
    }
    sequence = RunSequence(planned({"leader": LEADER, "follower": FOLLOWER}, on_scene))
    assert {arm for arm, _ in started(sequence)} == {"mover", "left"}
    sequence.result("mover", True, "")
    assert sequence.finish() == ["left"]


def test_endless_tasks_alone_go_on_until_they_have_ended(planned):
    sequence = RunSequence(planned({"follower": FOLLOWER}, {"follower": {"goals": [{"name": "hold"}]}}))
    started(sequence)
    for arm in ("left", "right"):
        assert not sequence.over and sequence.finish() == []
        sequence.result(arm, True, "")
    assert sequence.finished
