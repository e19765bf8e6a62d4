"""What a user reads where somebody else's code raises: whose it is, file and line, and a traceback."""

import json
import sys

import pytest
from other_package import ERRORS, FOLDER, installed

from tactile_base import raised
from tactile_bringup import cli
from tactile_bringup.commands.changes import refusing
from tactile_scene.shapes import SHAPES


def line_of(words: str) -> str:
    """File and line of these words in the other package, as a message ends with them."""
    lines = (FOLDER / "my_errors.py").read_text().splitlines()
    return f"my_errors.py:{1 + next(k for k, line in enumerate(lines) if words in line)})"


SCENE = """\
arms:
  arm: {{driver: sim, base: {{position: [-0.45, 0, 0]}},
        start: {{position: [0, 0, 0.032], rotation_deg: [0, 180, 0]}},
        sensor: {{in_tool: {{position: [0, 0, 0.065]}}}}}}
bodies:
  body: {body}
"""
TASK = "roles:\n  follower: {{task: {task}}}\nscenes:\n  cell:\n    follower: {{goals: [{{name: along}}]}}\n"


@pytest.fixture
def errors(tmp_path, monkeypatch):
    """A package of somebody else, installed."""
    (tmp_path / "site").mkdir()
    for folder in installed(tmp_path / "site", ERRORS):
        monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(raised, "_PLUGINS", {})
    yield
    sys.modules.pop("my_errors", None)


@pytest.fixture
def simulate(errors, tmp_path, capsys):
    """`tactile simulate` of a task on a body: exit code, screen, results."""

    def run(task="surface_following", body="{shape: plane}"):
        (tmp_path / "cell.yaml").write_text(SCENE.format(body=body))
        (tmp_path / "task.yaml").write_text(TASK.format(task=task))
        out = tmp_path / "out"
        words = ["simulate", str(tmp_path / "task.yaml"), "--scene", str(tmp_path / "cell.yaml")]
        code = cli.main([*words, "--fidelity", "ideal", "--out", str(out)])
        shown = capsys.readouterr()
        report = out / "report.json"
        return code, shown.out + shown.err, json.loads(report.read_text()) if report.exists() else None, out

    return run


def test_a_task_that_raises_in_a_library_is_told_with_its_own_line_everywhere(simulate):
    code, shown, report, out = simulate("rubbing")
    words = "task 'rubbing': LinAlgError in phase follow: Singular matrix ("
    assert code == 1 and not report["succeeded"]
    for text in (shown, report["reason"]):
        assert words in text and line_of("np.linalg.inv") in text
    log = (out / "errors.log").read_text()
    assert "Traceback" in log and "np.linalg.inv" in log and str(out / "errors.log") in shown


def test_a_task_that_cannot_be_made_fails_the_run_with_its_line(simulate):
    code, shown, report, _ = simulate("refusing")
    assert code == 1 and "task 'refusing': KeyError: 'speed' (" in shown
    assert line_of("KeyError(") in report["reason"]


def test_a_task_whose_step_gives_nothing_fails_with_what_it_must_give(simulate):
    code, shown, report, _ = simulate("silent")
    assert code == 1 and "task 'silent': step gives a NoneType, must be a Command (" in report["reason"]
    assert line_of("def step(self, now_ns") in shown


def test_a_motion_that_raises_in_the_midst_of_a_run_leaves_a_report(simulate):
    code, shown, report, out = simulate(body="{shape: plane, motion: swing}")
    assert code == 1 and "body motion 'swing': KeyError: 'height' (" in shown
    assert line_of("return {}[") in report["reason"] and report["frames"]["exposed"] > 10
    assert '{}["height"]' in (out / "errors.log").read_text()


def test_a_shape_that_raises_before_anything_runs_is_told_with_its_line_and_traceback(simulate):
    code, shown, _, _ = simulate(body="{shape: bowl}")
    assert "shape 'bowl': ValueError: could not convert string to float: 'fast' (" in shown, shown
    assert line_of("ValueError(") in shown and code in (1, 2)


def test_what_a_plugin_raises_in_any_command_has_its_name_place_and_traceback(errors, capsys):
    """`refusing`, which runs every command: whatever kind of error it is."""
    bowl = SHAPES.load("bowl")

    def run(arguments):
        bowl(bowl.settings_class()).query(None)

    assert refusing(run, "tactile report")(None) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("tactile report: shape 'bowl': ValueError: could not convert")
    assert lines[0].endswith(line_of("ValueError(")) and lines[1].startswith("Traceback")
