"""`tactile arm check`: a good arm passes, and each thing that is wrong with another is said."""

import sys

import numpy as np
import pytest
from other_package import installed

from tactile_bringup import arm_check, cli
from tactile_bringup.findings import FAILED, LOOK, OK
from tactile_bringup.staged_arm import StagedArm, Stopped
from tactile_scene.arm import ArmMode, ArmState
from tactile_scene.scene_file import load_scene

pytestmark = pytest.mark.live  # it measures times

CELL = """
arms:
  arm:
    driver: bench_arm
    driver_settings: {%s}
    start: {position: [0, 0, 0.3], rotation_deg: [0, 180, 0]}
    sensor: {in_tool: {position: [0, 0, 0.065]}}
    %s
"""
BOX = "safety: {workspace_lower: [-0.2, -0.2, 0.29], workspace_upper: [0.2, 0.2, 0.4]}"


@pytest.fixture
def check(tmp_path, monkeypatch, capsys):
    """Runs the command on an arm with these settings; its exit code and what it says."""
    (tmp_path / "site").mkdir()
    folders = installed(tmp_path / "site")
    for folder in folders:
        monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", ":".join([*folders, *sys.path]))
    for name, seconds in (("LISTEN", 0.5), ("SECONDS", 0.4), ("HANGS", 0.3)):
        monkeypatch.setattr(arm_check, name, seconds)

    def run(settings="", more=BOX, *options):
        (tmp_path / "cell.yaml").write_text(CELL % (settings, more))
        code = cli.main(["arm", "check", "--scene", str(tmp_path / "cell.yaml"), *options])
        out, err = capsys.readouterr()
        return code, " ".join((out + err).split())

    yield run
    sys.modules.pop("bench_cell", None)


def test_an_arm_that_keeps_what_it_says_passes_at_rest(check):
    code, said = check()
    assert code == 0, said
    assert "ok connection: the arm answered" in said and "look stops: not measured" in said
    assert "10 mm ahead" not in said and "10 mm from the start along the tip" in said


BODY = "bodies: {table: {shape: plane, pose: {position: [0, 0, %g], rotation_deg: [%g, 0, 0]}}}"


@pytest.mark.parametrize(
    "height, tilt, code, words",
    [
        (
            0.268,
            0,
            0,
            "look start: tasks begin 12.0 mm above 'table', 0.0 deg from its normal: does the surface",
        ),
        (0.268, 12, 0, "12.0 deg from its normal; the first one better 5 to 15 mm above, upright"),
        (0.2, 0, 0, "80.0 mm above 'table', 0.0 deg from its normal; the first one better"),
        (0.285, 0, 1, "FAILED start: tasks would begin 5.0 mm inside of 'table'"),
    ],
)
def test_where_tasks_begin_is_told_by_the_surface_below(check, height, tilt, code, words):
    found, said = check("", f"{BOX}\n{BODY % (height, tilt)}")
    assert found == code and words in said, said


def test_first_days_are_slow_and_the_arms_own_limit_of_force_is_asked_for(check):
    assert (
        "ok speed: limits are 20 mm/s, 0.2 rad/s"
        in check("", BOX + "\n    limits: {linear_velocity: 0.02, angular_velocity: 0.2}")[1]
    )
    said = check()[1]
    assert "20 and 0.2 until ten runs were good" in said
    assert "look force: the force at which it stops itself is set at its controller" in said


def test_an_arm_that_keeps_what_it_says_passes_in_motion(check):
    code, said = check("", BOX, "--move")
    for what in ("direction", "round trip", "stop", "emergency stop", "reset", "computer hangs"):
        assert f"ok {what}: " in said, said
    # it has no watchdog of its own
    assert "look commands end: the driver goes on: only the arm's node stops it" in said
    assert code == 0


@pytest.mark.parametrize(
    "settings, more, options, words",
    [
        ("", "", (), "FAILED workspace: [-2.0, -2.0, -2.0] to [2.0, 2.0, 2.0] m, the default"),
        ("", BOX.replace("0.29", "0.31"), (), "FAILED workspace: the start of tasks: "),
        ("host: nowhere", BOX, (), "no answer from nowhere"),
        ("states: 2", BOX, (), "FAILED states: 2 came in"),
        ("nowhere: true", BOX, (), "FAILED place: "),
        ("deaf: true", BOX, ("--move",), "FAILED"),
        ("", BOX.replace("0.4]", "0.31]"), ("--move",), "FAILED room: no 25 mm to move away"),
    ],
)
def test_what_is_wrong_is_said(check, settings, more, options, words):
    code, said = check(settings, more, *options)
    assert code in (1, 2) and words in said, said


def test_a_simulated_arm_has_no_driver_to_check(capsys):
    assert cli.main(["arm", "check", "--scene", "plane"]) == 2
    assert "'arm' has no driver of its own, but 'sim'" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    "seconds, way, gap, verdict",
    [
        (0.1, 0.5e-3, 0.002, OK),
        (0.1, 1.15e-3, 0.04, LOOK),
        (0.1, 1.15e-3, 0.002, FAILED),
        (np.inf, 0.5e-3, 0.04, FAILED),
    ],
)
def test_a_stop_that_took_too_long_failed_unless_the_computer_was_held_up(seconds, way, gap, verdict):
    arm = load_scene("ur_example").arms["arm"]
    assert arm_check.judge_stop(arm, "stop", Stopped(seconds, way, gap), 0.011).verdict == verdict


def test_states_that_come_while_others_are_looked_at_are_none_of_them():
    """Two arrays made of them, one after the other, were of two lengths."""
    arm = load_scene("ramp").arms["arm"]
    reports = []
    staged = StagedArm(arm, lambda report: reports.append(report))
    state = ArmState(1, arm.T_base_start, np.zeros(6), ArmMode.RESTING)
    for _ in range(3):
        reports[0](state)
    looked_at = staged.states
    reports[0](state)
    assert len(looked_at) == 3 and len(staged.states) == 4
