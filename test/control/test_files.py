"""Controller and task files: the paper's tables arrive in SI; a mistake is named with file and line."""

import numpy as np
import pytest

from tactile_base.settings import SettingError
from tactile_control.task_file import load_controller, load_task

TASK = """\
task: surface_following
controller: surface_following
settings:
  task:
    speed: 0.012
scenes:
  ramp:
    paths:
      - {name: up, direction_deg: 90.0, length: 0.1}
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
    settings = load_controller(config / "controllers" / "surface_following.yaml")
    assert settings.pid.kp == (0, 0, 2, 2, 2, 0)
    assert settings.pid.ki == (0, 0, 0.1, 0.1, 0.1, 0)
    assert settings.pid.kd == (0, 0, 0.05, 0.05, 0.05, 0)
    assert settings.pid.integral_limit == (0.025, 0.025, 0.025, 25, 25, 25)
    assert settings.servoing.reference == (0, 0, 0.003, 0, 0, 0)


def test_object_tracking_holds_the_papers_table_in_si(config):
    settings = load_controller(config / "controllers" / "object_tracking.yaml")
    assert settings.pid.kp == (5, 5, 5, 2, 2, 0)
    assert settings.servoing.reference == (0, 0, 0.006, 0, 0, 0)
    assert settings.pid.integral_limit == (np.inf,) * 6


def test_the_dome_has_eight_radial_paths_at_45_degrees(config):
    task = load_task(config / "tasks" / "surface_following.yaml", "dome")
    np.testing.assert_allclose([path.direction for path in task.paths], np.arange(8) * np.pi / 4)
    assert task.settings.task.speed == 0.010


def test_settings_of_the_task_go_over_those_of_the_controller(write):
    path, controllers = write(TASK)
    task = load_task(path, "ramp", controllers)
    assert task.settings.task.speed == 0.012 and task.settings.pid.kp[2] == 2.0
    assert task.paths[0].name == "up" and task.paths[0].direction == pytest.approx(np.pi / 2)


@pytest.mark.parametrize(
    "old, new, line, message",
    [
        ("speed:", "sped:", 5, "did you mean 'speed'"),
        ("speed: 0.012", "speed: 12.0", 5, r"speed = 12.0 m/s: must lie in \[0, 0.2\] m/s"),
        ("speed: 0.012", "speed: fast", 5, "must be of type float, is str"),
        ("task:\n", "tusk:\n", 4, "unknown name 'tusk'"),
        (
            "controller: surface_following",
            "controller: surface_folowing",
            2,
            "did you mean 'surface_following'",
        ),
        ("length:", "lenght:", 9, "did you mean 'length'"),
        (", length: 0.1", "", 9, "path 0.length is missing"),
        ("length: 0.1", "length: -1", 9, r"length = -1.0 m: must lie in \(0, 100\) m"),
        ("name: up", "name: up, start: [0, 0, 0]", 9, "path 0"),
        ("task: surface_following\n", "task: surface_folowing\n", 1, "did you mean 'surface_following'"),
        ("    speed: 0.012\n", "    speed: 0.012\n    speed: 0.013\n", 6, "'speed' is given twice"),
        ("scenes:", "scenes: [", 8, ""),
    ],
)
def test_a_mistake_is_named_with_file_and_line(write, old, new, line, message):
    assert old in TASK
    path, controllers = write(TASK.replace(old, new, 1))
    with pytest.raises(SettingError, match=rf"task\.yaml:{line}: .*{message}"):
        load_task(path, "ramp", controllers)


def test_a_scene_without_paths_is_named_with_those_that_have(write):
    path, controllers = write(TASK)
    with pytest.raises(SettingError, match=r"unknown name 'rump'.*did you mean 'ramp'"):
        load_task(path, "rump", controllers)
