"""RunRecord keeps its columns aligned and survives the way to a file and back."""

import numpy as np
import pytest

from tactile_records.runs.record import CommandSeries, PoseSeries, RunRecord, StageSeries, TruthSeries


def small_record() -> RunRecord:
    stamps = np.arange(5) * 10
    command = CommandSeries(
        stamps, twist=np.ones((5, 6)), phase=["approach"] * 2 + ["follow"] * 3, goal=[0] * 5
    )
    record = RunRecord(scene="ramp", task="surface_following", command=command, goals=["up"])
    record.pose = PoseSeries(stamps, np.tile(np.eye(4), (5, 1, 1)))
    record.latency = {"estimate": StageSeries(stamps, np.full(5, 0.004))}
    record.T_world_base = np.diag([-1.0, -1.0, 1.0, 1.0])
    record.result = {"succeeded": True, "reason": ""}
    return record


def test_record_survives_saving_and_loading(tmp_path):
    record = small_record()
    record.save(tmp_path / "run.npz")
    loaded = RunRecord.load(tmp_path / "run.npz")
    assert loaded.scene == "ramp" and loaded.goals == ["up"] and loaded.result == record.result
    np.testing.assert_array_equal(loaded.T_world_base, record.T_world_base)
    np.testing.assert_array_equal(loaded.command.phase, record.command.phase)
    np.testing.assert_array_equal(loaded.pose.T_base_sensor, record.pose.T_base_sensor)
    np.testing.assert_array_equal(loaded.latency["estimate"].seconds, record.latency["estimate"].seconds)


def test_phase_holds_from_one_command_to_the_next():
    phases = small_record().phase_at(np.array([-1, 0, 19, 20, 99]))
    assert phases.tolist() == ["", "approach", "approach", "follow", "follow"]


def test_the_goal_holds_from_one_command_to_the_next_and_is_minus_one_before():
    record = small_record()
    record.command.goal[3:] = 1
    assert record.goal_at(np.array([-1, 0, 29, 30, 99])).tolist() == [-1, 0, 0, 1, 1]


def test_the_reference_holds_until_another_follows_and_the_first_one_before_it():
    record = small_record()
    record.command.reference[1:3] = [0, 0, 0.003, 0, 0, 0]
    record.command.reference[4] = [0, 0, 0.006, 0, 0, 0]
    depths = record.reference_at(np.array([0, 10, 30, 39, 40, 99]))[:, 2]
    assert depths.tolist() == [0.003, 0.003, 0.003, 0.003, 0.006, 0.006]


def test_contacts_of_a_run_without_a_reference_are_held_against_none():
    assert small_record().reference_at(np.zeros(0)).shape == (0, 6)
    assert np.isnan(small_record().reference_at(np.array([20, 30]))).all()


def test_columns_not_recorded_are_nan():
    assert np.isnan(small_record().command.error).all()


def test_a_column_of_the_wrong_shape_is_refused_by_name():
    with pytest.raises(ValueError, match=r"TruthSeries\.T_fs: shape \(2, 3, 3\), must be \(2, 4, 4\)"):
        TruthSeries(np.arange(2), np.zeros((2, 3, 3)))
