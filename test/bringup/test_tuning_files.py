"""What was tuned, saved: the next launch has just these settings."""

import dataclasses
import shlex
import shutil

import pytest
import yaml

from tactile_base.config_paths import config_path
from tactile_base.settings import SettingError
from tactile_bringup.cli import command_line
from tactile_bringup.tuning import RuntimeSetting, Tuning, plain
from tactile_bringup.tuning_files import saved
from tactile_control.task_file import load_task, task_path
from tactile_filter.filter_settings import FilterSettings, load_filter_settings

KIND, SCENE = "surface_following", "ramp"


def graph_of(task, **now) -> Tuning:
    """A controller of its last role, as a launch starts it, and a filter; `now` has changed since."""
    tuning = Tuning()
    role = task.roles[-1]
    groups = dataclasses.asdict(role.settings)
    values = {f"{group}.{name}": plain(v) for group, of in groups.items() for name, v in of.items()}
    values |= {"task_name": role.task, "timing.watchdog_period": 0.01}
    add(tuning, f"/{(role.arms or ('arm',))[0]}/controller", values, now)
    add(tuning, "/arm/filter", dataclasses.asdict(FilterSettings()) | {"inputs.tf_rate": 15.0}, now)
    add(tuning, "/sim", {"scene": str(config_path(f"scenes/{task.scene}.yaml"))}, {})
    return tuning


def add(tuning: Tuning, node: str, values: dict, now: dict) -> None:
    changed = {name.replace("__", "."): value for name, value in now.items()}
    tuning.found(node, [RuntimeSetting(node, n, changed.get(n, v), v) for n, v in values.items()])


def launched(lines: list[str]):
    """The task and the filter that the commands among these lines launch."""
    words = [
        word for line in lines if "tactile launch" in line for word in shlex.split(line)[2:] if word != ".."
    ]
    given = command_line().parse_args(["launch", *words])
    path = task_path(given.task)
    return load_task(path, given.scene or SCENE, controller=given.controller, changes=given.changes), given


def test_the_command_that_is_told_launches_what_was_in_force(tmp_path):
    """The gains by the file; what the packaged task sets itself, by --set."""
    task = load_task(task_path(KIND), SCENE)
    kp = (1.0, 1.0, 2.0, 2.0, 2.0, 0.5)
    lines = saved(graph_of(task, pid__kp=kp, task__speed=0.02, task__corridor=0.006), tmp_path / "new")
    again, given = launched(lines)
    settings = again.roles[0].settings
    assert settings == task.roles[0].settings.replaced(pid__kp=kp, task__speed=0.02, task__corridor=0.006)
    assert given.scene == SCENE and given.changes == ["follower.task.speed=0.02"]


def test_a_role_among_others_is_named(tmp_path):
    task = load_task(task_path("object_tracking"), "tracking_flat")
    lines = saved(graph_of(task, pid__ewma_decay=0.25), tmp_path)
    again, given = launched(lines)
    assert given.controller.startswith("follower=")
    assert again.role("follower").settings == task.role("follower").settings.replaced(pid__ewma_decay=0.25)


def test_a_filter_has_a_file_of_its_own_and_the_rest_ros_parameters(tmp_path):
    tuning = graph_of(load_task(task_path(KIND), SCENE), gate_probability=0.9, inputs__tf_rate=30.0)
    lines = saved(tuning, tmp_path)
    assert load_filter_settings(tmp_path / "arm.filter.yaml") == FilterSettings(gate_probability=0.9)
    assert yaml.safe_load((tmp_path / "parameters.yaml").read_text()) == {
        "/arm/filter": {"ros__parameters": {"inputs.tf_rate": 30.0}}
    }
    assert [line for line in lines if "params_file:=" in line]
    assert not (tmp_path / "arm.controller.yaml").exists()


@pytest.fixture
def task_file(tmp_path):
    """A task of one's own, beside which there are no controllers."""
    folder = tmp_path / "tasks"
    folder.mkdir()
    return shutil.copy(task_path(KIND), folder / "mine.yaml")


def test_a_task_file_takes_the_settings_and_keeps_its_comments(task_file):
    before = load_task(task_file, SCENE)
    lines = saved(graph_of(before, pid__kd=(0.1,) * 6, task__speed=0.02, contact__dry_touch=True), task_file)
    after = load_task(task_file, SCENE).roles[0].settings
    assert after == before.roles[0].settings.replaced(
        pid__kd=(0.1,) * 6, task__speed=0.02, contact__dry_touch=True
    )
    assert "# surface_following is the paper's own table" in task_file.read_text()
    assert launched(lines)[0].roles[0].settings == after


def test_what_a_scene_sets_is_set_there(task_file):
    before = load_task(task_file, "two_arms")
    saved(graph_of(before, contact__settle_time=2.0, task__speed=0.02), task_file)
    assert load_task(task_file, "two_arms").roles[0].settings.contact.settle_time == 2.0
    assert load_task(task_file, SCENE).roles[0].settings.contact.settle_time != 2.0
    assert load_task(task_file, SCENE).roles[0].settings.task.speed == 0.02


def test_a_task_file_that_has_no_such_role_stays_as_it_was(tmp_path):
    tuning = graph_of(load_task(task_path(KIND), SCENE), task__speed=0.02)
    file = shutil.copy(task_path("pushing"), tmp_path / "pushing.yaml")
    text = file.read_text()
    with pytest.raises(SettingError):
        saved(tuning, file)
    assert file.read_text() == text


def test_nothing_is_written_where_nothing_differs_or_there_is_no_such_file(tmp_path):
    task = load_task(task_path(KIND), SCENE)
    with pytest.raises(SettingError, match="nothing differs"):
        saved(graph_of(task), tmp_path / "new")
    with pytest.raises(SettingError, match="no such task file"):
        saved(graph_of(task, task__speed=0.02), tmp_path / "mistyped.yaml")
    assert not list(tmp_path.iterdir())


def test_a_controller_file_by_its_path_is_one_that_a_launch_takes(tmp_path):
    (tmp_path / "gains.yaml").write_text("pid: {ewma_decay: 0.25}\n")
    task = load_task(task_path(KIND), SCENE, controller=str(tmp_path / "gains.yaml"))
    assert task.roles[0].settings.pid.ewma_decay == 0.25
    with pytest.raises(SettingError, match=r"unknown name 'gains'.*or give the path of a \.yaml file"):
        load_task(task_path(KIND), SCENE, controller="gains")
