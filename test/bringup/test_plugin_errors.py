"""What a user reads where somebody else's code raises: whose it is, file and line, and a traceback."""

import json
import sys

import pytest

from tactile_base import raised
from tactile_bringup import cli
from tactile_bringup.commands.changes import refusing
from tactile_drivers.shapes import SHAPES

POINTS = """\
[tactile_servoing.tasks]
rubbing = my_errors:Rubbing
refusing = my_errors:Refusing
[tactile_servoing.motions]
swing = my_errors:Swing
[tactile_servoing.shapes]
bowl = my_errors:Bowl
"""
MODULE = """\
import numpy as np

from tactile_control.tasks.surface_following import SurfaceFollowing
from tactile_drivers.shapes.sphere import Sphere
from tactile_drivers.sim.motions import Fixed


class Rubbing(SurfaceFollowing):
    def reference_velocity(self, elapsed):
        return np.linalg.inv(np.zeros((2, 2)))


class Refusing(SurfaceFollowing):
    def __init__(self, settings, goal, start):
        raise KeyError("speed")


class Swing(Fixed):
    def step(self, dt, tools, contacts):
        if contacts:
            return {}["height"]
        return Fixed.step(self, dt, tools, contacts)


class Bowl(Sphere):
    def query(self, points):
        raise ValueError("could not convert string to float: 'fast'")
"""
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
def installed(tmp_path, monkeypatch):
    """A package of somebody else, installed."""
    site = tmp_path / "site"
    info = site / "my_errors-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-errors\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(POINTS)
    (site / "my_errors.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setattr(raised, "_PLUGINS", {})
    yield
    sys.modules.pop("my_errors", None)


@pytest.fixture
def simulate(installed, tmp_path, capsys):
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
        assert words in text and "my_errors.py:10)" in text
    log = (out / "errors.log").read_text()
    assert "Traceback" in log and "np.linalg.inv" in log and str(out / "errors.log") in shown


def test_a_task_that_cannot_be_made_fails_the_run_with_its_line(simulate):
    code, shown, report, _ = simulate("refusing")
    assert code == 1 and "task 'refusing': KeyError: 'speed' (" in shown
    assert "my_errors.py:15)" in report["reason"]


def test_a_motion_that_raises_in_the_midst_of_a_run_leaves_a_report(simulate):
    code, shown, report, out = simulate(body="{shape: plane, motion: swing}")
    assert code == 1 and "body motion 'swing': KeyError: 'height' (" in shown
    assert "my_errors.py:21)" in report["reason"] and report["frames"]["exposed"] > 10
    assert '{}["height"]' in (out / "errors.log").read_text()


def test_a_shape_that_raises_before_anything_runs_is_told_with_its_line_and_traceback(simulate):
    code, shown, _, _ = simulate(body="{shape: bowl}")
    assert "shape 'bowl': ValueError: could not convert string to float: 'fast' (" in shown, shown
    assert "my_errors.py:27)" in shown and code in (1, 2)


def test_what_a_plugin_raises_in_any_command_has_its_name_place_and_traceback(installed, capsys):
    """`refusing`, which runs every command: whatever kind of error it is."""
    bowl = SHAPES.load("bowl")

    @refusing("report", status=2)
    def run(arguments):
        bowl(bowl.settings_class()).query(None)

    assert run(None) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("tactile report: shape 'bowl': ValueError: could not convert")
    assert lines[0].endswith("my_errors.py:27)") and lines[1].startswith("Traceback")
