"""Controller and task files: the paper's tables arrive in SI; a mistake is named with file and line."""

import numpy as np
import pytest

from tactile_base.settings import SettingError
from tactile_control.task_file import default_scene, load_controller, load_task
from tactile_control.tasks.object_tracking import ObjectTracking, ObjectTrackingSettings
from tactile_control.tasks.surface_following import SurfaceFollowing, SurfaceFollowingSettings

TASK = """\
roles:
  follower:
    task: surface_following
    controller: surface_following
    settings:
      task:
        speed: 0.012
scenes:
  ramp:
    follower:
      settings: {contact: {settle_time: 1.5}}
      goals:
        - {name: up, direction_deg: 90.0, length: 0.1}
"""
ROLES = """\
roles:
  leader: {task: trajectory}
  follower: {task: object_tracking, controller: object_tracking}
scenes:
  tracking:
    leader:
      arms: [left]
      after: {follower: track}
      ends_run: true
      goals:
        - {displacement: [0.02, 0, 0, 0, 0, 0], start: [0, 0, 0.1, 0, 0, 0]}
        - {amplitude: [0.01, 0, 0, 0, 0, 0]}
    follower:
      arms: [right]
      goals: [{name: track}]
"""


@pytest.fixture
def config(request):
    return request.config.rootpath / "config"


@pytest.fixture
def write(tmp_path, config):
    def _write(text):
        path = tmp_path / "task.yaml"
        path.write_text(text)
        return path, config / "controllers"

    return _write


def test_surface_following_holds_the_papers_table_in_si(config):
    settings = load_controller(config / "controllers" / "surface_following.yaml", SurfaceFollowingSettings())
    assert settings.pid.kp == (0, 0, 2, 2, 2, 0)
    assert settings.pid.ki == (0, 0, 0.1, 0.1, 0.1, 0)
    assert settings.pid.kd == (0, 0, 0.05, 0.05, 0.05, 0)
    assert settings.pid.integral_limit == (0.025, 0.025, 0.025, 25, 25, 25)
    assert settings.servoing.reference == (0, 0, 0.003, 0, 0, 0)


def test_object_tracking_holds_the_papers_table_in_si(config):
    settings = load_controller(config / "controllers" / "object_tracking.yaml", ObjectTrackingSettings())
    assert settings.pid.kp == (5, 5, 5, 2, 2, 0)
    assert settings.servoing.reference == (0, 0, 0.006, 0, 0, 0)
    assert settings.pid.integral_limit == (np.inf,) * 6


def test_the_gains_of_another_tasks_controller_are_taken_without_what_only_that_task_has(config):
    path = config / "controllers" / "object_tracking_tuned.yaml"
    follows, tracks = (
        load_controller(path, kind()) for kind in (SurfaceFollowingSettings, ObjectTrackingSettings)
    )
    assert follows.pid == tracks.pid and follows.servoing.reference[2] == 0.004
    assert follows.task == SurfaceFollowingSettings().task and tracks.task.feedforward == 1.0


def test_a_task_of_ones_own_that_extends_another_has_the_settings_of_that(config):
    class Mine(ObjectTrackingSettings):
        pass

    settings = load_controller(config / "controllers" / "object_tracking_tuned.yaml", Mine())
    assert type(settings) is Mine and settings.task.feedforward == 1.0


@pytest.mark.parametrize(
    "text, message",
    [
        ("tasks:\n  object_trekking: {}\n", "mine.yaml:1: tasks: unknown name 'object_trekking'"),
        ("tasks:\n  object_tracking:\n    task: {speed: 1.0}\n", "mine.yaml:3: .*unknown name 'speed'"),
        ("task: {feedforward: 1.0}\n", "mine.yaml:1: task: unknown name 'feedforward'"),
    ],
)
def test_mistakes_in_what_one_task_has_are_told_with_file_and_line(tmp_path, text, message):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    base = SurfaceFollowingSettings() if text.startswith("task:") else ObjectTrackingSettings()
    with pytest.raises(SettingError, match=message):
        load_controller(path, base)


def test_the_dome_has_eight_radial_paths_at_45_degrees(config):
    role = load_task(config / "tasks" / "surface_following.yaml", "dome").role("follower")
    np.testing.assert_allclose([named.goal.direction_deg for named in role.goals], np.arange(8) * 45.0)
    assert role.settings.task.speed == 0.010


def test_settings_of_the_role_go_over_those_of_the_controller_and_those_of_the_scene_over_both(write):
    path, controllers = write(TASK)
    role = load_task(path, "ramp", controllers).role("follower")
    assert role.settings.task.speed == 0.012 and role.settings.pid.kp[2] == 2.0
    assert role.settings.contact.settle_time == 1.5
    assert role.goals[0].name == "up" and role.goals[0].goal.direction_deg == 90.0
    assert role.task_type is SurfaceFollowing and role.controller == "surface_following"


def test_roles_say_who_does_what_after_whom_and_whose_end_is_that_of_the_run(write):
    path, controllers = write(ROLES)
    leader, follower = load_task(path, "tracking", controllers).roles
    assert (leader.name, leader.task, leader.arms) == ("leader", "trajectory", ("left",))
    assert leader.after == ("follower", "track") and leader.ends_run
    assert [goal.name for goal in leader.goals] == ["goal_0", "goal_1"]
    np.testing.assert_allclose(leader.goals[0].start[:3, 3], [0.0, 0.0, 0.1])
    assert leader.goals[1].start is None and leader.goals[1].goal.amplitude[0] == 0.01
    assert follower.task_type is ObjectTracking and follower.settings.servoing.reference[2] == 0.006
    assert follower.after is None and not follower.ends_run
    assert default_scene(path) == "tracking"


@pytest.mark.parametrize(
    "old, new, line, message",
    [
        ("speed:", "sped:", 7, "did you mean 'speed'"),
        ("speed: 0.012", "speed: 12.0", 7, r"speed = 12.0 m/s: must lie in \[0, 0.2\] m/s"),
        ("speed: 0.012", "speed: fast", 7, "must be of type float, is str"),
        ("      task:\n", "      tusk:\n", 6, "unknown name 'tusk'"),
        ("controller: surf", "controller: srf", 4, "did you mean 'surface_following'"),
        ("length:", "lenght:", 13, "did you mean 'length'"),
        ("length: 0.1", "length: -1", 13, r"length = -1.0 m: must lie in \[0.0001, 10\] m"),
        ("name: up", "name: up, start: [0, 0, 0]", 13, "goal 0"),
        ("task: surface_following\n", "task: surface_folowing\n", 3, "did you mean 'surface_following'"),
        (
            "        speed: 0.012\n",
            "        speed: 0.012\n        speed: 0.013\n",
            8,
            "'speed' is given twice",
        ),
        ("settle_time", "setle_time", 11, "did you mean 'settle_time'"),
        ("  ramp:\n    follower:", "  ramp:\n    folower:", 10, "did you mean 'follower'"),
        ("scenes:", "scenes: [", 10, "not valid YAML"),
    ],
)
def test_a_mistake_is_named_with_file_and_line(write, old, new, line, message):
    assert old in TASK
    path, controllers = write(TASK.replace(old, new, 1))
    with pytest.raises(SettingError, match=rf"task\.yaml:{line}: .*{message}"):
        load_task(path, "ramp", controllers)


@pytest.mark.parametrize(
    "old, new, line, message",
    [
        ("after: {follower: track}", "after: {folower: track}", 8, "did you mean 'follower'"),
        ("after: {follower: track}", "after: {follower: track, leader: move}", 8, "one role and its phase"),
        ("ends_run: true", "ends_run: soon", 9, "must be true or false"),
        ("ends_run: true", "end_run: true", 9, "did you mean 'ends_run'"),
        ("task: trajectory", "task: trajectroy", 2, "did you mean 'trajectory'"),
        ("displacement: [0.02, 0, 0, 0, 0, 0]", "displacement: [0.02, 0, 0]", 11, "6 elements"),
        ("[{name: track}]", "[]", 15, "at least one goal"),
        ("[{name: track}]", "[{name: track, duration: -1}]", 15, r"duration = -1.0 s: must lie in \[0, "),
        ("displacement: [0.02, 0", "displacement: [0.0, 0", 11, "there is nothing to move along"),
    ],
)
def test_a_mistake_among_roles_is_named_with_file_and_line(write, old, new, line, message):
    assert old in ROLES
    path, controllers = write(ROLES.replace(old, new, 1))
    with pytest.raises(SettingError, match=rf"task\.yaml:{line}: .*{message}"):
        load_task(path, "tracking", controllers)


def test_a_phase_to_wait_for_that_the_other_task_does_not_have_is_refused(write):
    path, controllers = write(ROLES.replace("after: {follower: track}", "after: {follower: trakc}"))
    with pytest.raises(SettingError, match=r"task\.yaml:8: .*'trakc'.*did you mean 'track'"):
        load_task(path, "tracking", controllers)


def test_a_role_does_not_wait_for_itself(write):
    path, controllers = write(ROLES.replace("after: {follower: track}", "after: {leader: move}"))
    with pytest.raises(SettingError, match=r"task\.yaml:8: .*unknown name 'leader'.*valid: follower"):
        load_task(path, "tracking", controllers)


def test_arms_are_a_list(write):
    path, controllers = write(ROLES.replace("arms: [left]", "arms: left"))
    with pytest.raises(SettingError, match=r"task\.yaml:7: .*arms = 'left': must be a list of names"):
        load_task(path, "tracking", controllers)


def test_a_scene_without_goals_is_named_with_those_that_have(write):
    path, controllers = write(TASK)
    with pytest.raises(SettingError, match=r"unknown name 'rump'.*did you mean 'ramp'.*`goals_of: ramp`"):
        load_task(path, "rump", controllers)


def test_a_copied_scene_takes_the_goals_of_the_one_that_it_names(write):
    path, controllers = write(TASK)
    copied = load_task(path, "my_cell", controllers, goals_of="ramp")
    assert (copied.scene, copied.roles) == ("my_cell", load_task(path, "ramp", controllers).roles)
    with pytest.raises(SettingError, match="unknown name 'rimp'"):
        load_task(path, "my_cell", controllers, goals_of="rimp")


def test_a_scene_that_is_not_named_has_the_goals_of_other_scenes_where_there_are_some(write):
    path, controllers = write(TASK + "  other: {follower: {goals: [{name: across, length: 0.05}]}}\n")
    goals = [load_task(path, scene, controllers).role("follower").goals[0].name for scene in ("ramp", "mine")]
    assert goals == ["up", "across"]


@pytest.mark.parametrize("change", ["follower.task.speed=0.02", "task.speed=0.02"])
def test_a_change_goes_over_all_files_and_one_role_needs_no_name(write, change):
    path, controllers = write(TASK)
    role = load_task(path, "ramp", controllers, changes=[change]).role("follower")
    assert role.settings.task.speed == 0.02 and role.settings.contact.settle_time == 1.5


def test_of_changes_of_one_setting_the_last_holds_and_lists_can_be_given(write):
    path, controllers = write(ROLES)
    changes = ["leader.task.gain=1.0", "leader.task.gain=3.0", "follower.pid.kp=[1, 1, 1, 0, 0, 0]"]
    leader, follower = load_task(path, "tracking", controllers, changes=changes).roles
    assert leader.settings.task.gain == 3.0 and follower.settings.pid.kp == (1, 1, 1, 0, 0, 0)


@pytest.mark.parametrize(
    "change, message",
    [
        ("task.gain=1", "must have the form ROLE.GROUP.NAME=VALUE"),
        ("leader.gain", "leader.gain"),
        ("leader.task.gian=1", "did you mean 'gain'"),
        ("leader.tusk.gain=1", "unknown name 'tusk'"),
        ("laeder.task.gain=1", "did you mean 'leader'"),
        ("leader.task.gain=-1", r"gain = -1.0 1/s: must lie in \[0, 50\]"),
    ],
)
def test_a_wrong_change_says_what_would_be_right(write, change, message):
    path, controllers = write(ROLES)
    with pytest.raises(SettingError, match=message):
        load_task(path, "tracking", controllers, changes=[change])


def test_another_controller_is_for_the_roles_that_feel(write):
    path, controllers = write(ROLES)
    leader, follower = load_task(path, "tracking", controllers, controller="surface_following").roles
    assert (leader.controller, follower.controller) == ("", "surface_following")
    assert follower.settings.servoing.reference[2] == 0.003
    with pytest.raises(SettingError, match="did you mean 'surface_following'"):
        load_task(path, "tracking", controllers, controller="surface_folowing")
