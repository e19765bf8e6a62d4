"""Settings by hand: undone, done again, two sets, what differs, and the file that the next launch takes."""

import pytest
import yaml

from tactile_control.task_file import load_controller
from tactile_control.tasks import TASKS
from tactile_view.settings_panel import Changes, controller_file


@pytest.fixture
def changes() -> Changes:
    values = {"pid.kp": (1.0, 2.0), "task.depth": 0.003}
    return Changes(dict(values), dict(values))


def test_undo_and_redo_go_back_and_forth(changes):
    changes.note("task.depth", 0.004)
    changes.note("task.depth", 0.005)
    assert changes.back() == ("task.depth", 0.004) and changes.back() == ("task.depth", 0.003)
    assert changes.back() is None and changes.now == changes.first
    assert changes.again() == ("task.depth", 0.004)
    changes.note("pid.kp", (3.0, 4.0))
    assert changes.again() is None, "a new change ends what could be done again"


def test_what_differs_is_told_with_both_values(changes):
    assert changes.different() == {}
    changes.note("task.depth", 0.004)
    assert changes.different() == {"task.depth": (0.003, 0.004)}


def test_two_sets_are_kept_apart(changes):
    changes.note("task.depth", 0.004)
    assert changes.to_other_set() == {} and changes.chosen == "B"  # B begins with what is in force
    changes.note("task.depth", 0.002)
    assert changes.to_other_set() == {"task.depth": 0.004}
    changes.now["task.depth"] = 0.004
    assert changes.to_other_set() == {"task.depth": 0.002}


def test_the_file_is_one_that_a_launch_takes(tmp_path):
    settings = TASKS.load("surface_following").settings_class()
    text = controller_file(
        {"pid.kp": (1.0, 1.0, 2.0, 2.0, 2.0, 0.5), "task.corridor": 0.006}, "surface_following"
    )
    assert set(yaml.safe_load(text)) == {"pid", "tasks"}
    file = tmp_path / "controller.yaml"
    file.write_text(text)
    loaded = load_controller(file, settings)
    assert loaded.pid.kp == (1.0, 1.0, 2.0, 2.0, 2.0, 0.5) and loaded.task.corridor == 0.006
