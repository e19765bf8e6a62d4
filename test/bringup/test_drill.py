"""`tactile drill`: one fault after the other in a task on the simulated cell, and what counts as passed."""

import json
import math
from dataclasses import replace

import pytest

from tactile_base.settings import SettingError
from tactile_bringup import cli
from tactile_bringup.drill import Drill, Outcome, faults
from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_control.task_file import load_task, task_path
from tactile_doubles.lies import Lies
from tactile_scene.scene_file import load_scene

SHORT = ("--scene", "plane", "--fidelity", "ideal")


def drill(**options):
    chosen = OfflineOptions(**{"fidelity": "ideal", "time_limit": 60.0, **options})
    return Drill(load_scene("plane"), load_task(task_path("surface_following"), "plane"), chosen)


@pytest.mark.parametrize("name", ["arm: servo_off", "estimates: z flipped"])
def test_what_lies_in_mid_task_is_known_stopped_and_passed(name):
    (outcome,) = drill().run({name: faults(images=False)[name]})
    assert outcome.known < 1.0 and outcome.rest < 2.0
    assert 0.002 < outcome.deepest < 0.005 and outcome.deeper < 0.001
    assert 0.009 < outcome.fastest < 0.04  # 10 mm/s along the plane, 30 mm/s off it
    assert outcome.reason.startswith("arm: plane: ") and math.isinf(outcome.off)
    assert outcome.objection() == ""


def test_a_task_of_more_than_a_minute_is_drilled_and_ended_well_a_while_after_the_fault():
    task = load_task(task_path("object_tracking"), "tracking_flat")
    tracking = Drill(load_scene("tracking_flat"), task, OfflineOptions(fidelity="ideal", time_limit=60.0))
    chosen = {"nothing": Lies, "half as large": faults(images=False)["estimates: half as large"]}
    nothing, half = tracking.run(chosen, ("follower",))
    assert nothing.objection() == nothing.reason == "" and nothing.off == 0.0
    assert 0.03 < nothing.fastest < 0.06  # the plate is carried at up to 27 mm/s, and turned
    assert half.known < 0.1 and half.reason.startswith("leader: follower: track: within ")


def test_runs_end_so_long_after_all_arms_have_come_to_their_work():
    """The goal of the leader would go on for 90 s."""
    records = run_arms_offline("tracking_flat", "object_tracking", OfflineOptions("ideal", work_time=2.0))
    for record in records.values():
        command = record.command
        at_work = command.stamp_ns[command.phase == record.work]
        assert record.result["succeeded"] and 1.9e9 < at_work[-1] - at_work[0] < 3.1e9


def test_an_arm_that_cannot_be_stopped_has_to_be_told():
    (outcome,) = drill().run({"arm: moves_by_itself": faults(images=False)["arm: moves_by_itself"]}, ("arm",))
    assert math.isinf(outcome.rest) and "does not do what it is told" in outcome.reason
    assert outcome.objection() == ""
    assert replace(outcome, fault="arm: servo_off").objection() == "does not rest"


def test_a_task_that_fails_by_itself_is_no_drill():
    with pytest.raises(SettingError, match=r"arm: fails though nothing goes wrong: .*took too long"):
        list(drill(time_limit=2.0).run(faults(images=False)))


GOOD = Outcome("camera: black", "arm", 0.1, 0.2, 0.03, 0.003, 0.003, 0.0, math.inf, "no image of the sensor")


@pytest.mark.parametrize(
    "change, words",
    [
        ({}, ""),
        ({"deepest": 0.0071}, "7.1 mm deep, must stay below 6"),
        ({"rest": math.inf}, "does not rest"),
        ({"reason": "", "off": 0.001, "rest": math.inf}, ""),
        ({"reason": "", "off": 0.1}, "done, 100.0 mm off"),
    ],
)
def test_what_counts_as_passed(change, words):
    assert replace(GOOD, **change).objection() == words


def test_cameras_lie_where_there_are_images():
    assert any(name.startswith("camera: ") for name in faults(images=True))
    assert not any(name.startswith("camera: ") for name in faults(images=False))


def test_the_command_writes_its_rows_and_fails_where_one_is_not_passed(tmp_path, capsys):
    arguments = ["drill", *SHORT, "--fault", "flipped_y", "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 0
    said = capsys.readouterr().out
    assert "passed  arm: flipped_y (arm): at rest after 0." in said and "1 of 1 passed" in said
    (row,) = json.loads((tmp_path / "out" / "drill.json").read_text())
    assert row["fault"] == "arm: flipped_y" and row["objection"] == "" and row["off"] is None
    assert cli.main([*arguments, "--deepest", "1"]) == 1
    assert "mm deep, must stay below 1" in capsys.readouterr().out
    assert (tmp_path / "out-1" / "drill.json").exists()


@pytest.mark.parametrize(
    "arguments, words",
    [
        ((*SHORT, "--fault", "nothing"), "--fault nothing: there are arm: ignores_stop"),
        ((*SHORT, "--arm", "other"), "--arm: unknown name 'other'; valid: arm"),
        (
            ("--scene", "ur_example", "--live"),
            "arm: of a real driver: --rehearse with doubles, or --real-arms",
        ),
        (("--scene", "ur_example", "--live", "--rehearse", "--real-arms"), "not both"),
    ],
)
def test_what_cannot_be_drilled_is_refused(arguments, words, capsys, tmp_path):
    assert cli.main(["drill", *arguments, "--out", str(tmp_path)]) == 2
    assert words in " ".join(capsys.readouterr().err.split())


def test_a_scene_of_a_real_arm_is_drilled_with_a_simulated_one_in_its_place(tmp_path, capsys):
    words = ["drill", "--scene", "ur_example", "--fidelity", "ideal", "--fault", "arm: servo_off"]
    assert cli.main([*words, "--out", str(tmp_path / "out")]) == 0
    assert "1 of 1 passed" in capsys.readouterr().out


def test_faults_are_listed_and_nothing_is_done(capsys, monkeypatch, tmp_path):
    def runs(*given):
        raise AssertionError("a simulation was run")

    monkeypatch.setattr("tactile_bringup.drill.run_arms_offline", runs)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["drill", *SHORT, "--list"]) == 0
    assert "estimates: z flipped" in capsys.readouterr().out.splitlines()
    assert cli.main(["drill", "--scene", "ur_example", "--live", "--rehearse", "--list"]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert {"sim is killed", "arm is held up", "the arm's cable is out for a while"} <= set(listed)
    assert cli.main(["drill", "--scene", "ur_example", "--live", "--list"]) == 0  # lists, and moves no arm
    assert not list(tmp_path.iterdir())
