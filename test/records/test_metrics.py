"""Metrics against a run whose errors were put in by hand."""

import json
import re

import numpy as np
import pytest

from tactile_geometry import se3
from tactile_records.runs.euler_poses import euler_sigmas
from tactile_records.runs.metrics import REPORT_FIELDS, report, strongest_sinusoid
from tactile_records.runs.record import (
    BeliefSeries,
    CommandSeries,
    ForceSeries,
    GaussianSeries,
    PoseSeries,
    RunRecord,
    StageSeries,
    TruthSeries,
)
from tactile_records.runs.report import summary, write_numbers

PERIOD_NS = 16_666_667
RATE = 1e9 / PERIOD_NS


def poses(depth, alpha):
    return np.array(
        [se3.pose_from_euler(np.array([0, 0, d, a, 0, 0])) for d, a in zip(depth, alpha, strict=True)]
    )


def made_up(seconds=6.0, depth_error=0.0002, tilt=0.02, wobble=0.0, wobble_hz=3.0):
    """1 s of approach, then following at 10 mm/s along y with a constant depth error and tilt."""
    n = round(seconds * RATE)
    stamps = np.arange(n, dtype=np.int64) * PERIOD_NS
    t = stamps * 1e-9
    following = t >= 1.0
    depth = np.where(following, 0.003 + depth_error + wobble * np.sin(2 * np.pi * wobble_hz * t), -0.001)
    T_fs = poses(depth, np.where(following, tilt, 0.3))
    record = RunRecord(scene="plane", task="surface_following", goals=["along_y"])
    record.truth = TruthSeries(stamps, T_fs, slip_fraction=np.full(n, 0.25), in_contact=depth > 0)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 1, 3] = 0.010 * np.maximum(t - 1.0, 0.0)
    record.pose = PoseSeries(stamps, T)
    phase = np.where(following, "follow", "approach")
    phase[-1] = "done"
    reference = np.where((phase == "follow")[:, None], [0, 0, 0.003, 0, 0, 0], np.nan)
    record.command = CommandSeries(
        stamps, twist=np.zeros((n, 6)), phase=phase, goal=np.zeros(n), reference=reference
    )
    wrong = poses(depth + 0.0001, np.where(following, tilt + 0.01, 0.3))
    cov = np.tile(np.diag([1, 1, 0.0001**2, 1, 1, 1.0]), (n, 1, 1))
    X_sf = np.linalg.inv(wrong)
    record.estimate = GaussianSeries(stamps, X_sf, cov)
    record.belief = BeliefSeries(stamps, X_sf, cov, np.full(n, 12.0), np.full(n, 6), np.ones(n, bool))
    latency = np.linspace(0.0, 0.010, n)
    record.latency = {
        "estimator": StageSeries(stamps, latency / 2),
        "controller": StageSeries(stamps, latency),
    }
    record.result = {"succeeded": True, "reason": "", "wall_s": 1.5}
    return record


def written(record, path):
    return write_numbers({"arm": record}, "arm", path)


def test_quality_is_that_of_the_follow_phase_only():
    values = report(made_up())
    assert values["depth_rms_mm"] == pytest.approx(0.2) and values["depth_bias_mm"] == pytest.approx(0.2)
    assert values["normal_rms_deg"] == pytest.approx(np.degrees(0.02))
    assert values["contact_fraction"] == 1.0 and values["slip_fraction"] == 0.25


def test_length_and_speed_come_from_the_sensors_poses():
    values = report(made_up(seconds=6.0))
    assert values["path_length_mm"] == pytest.approx(50.0, abs=0.4)
    assert values["speed_mm_s"] == pytest.approx(10.0, rel=1e-6)
    assert values["goals"]["along_y"]["length_mm"] == pytest.approx(50.0, abs=0.4)
    assert values["goals"]["along_y"]["succeeded"]


def test_errors_of_estimate_and_belief_are_against_the_truth_of_the_same_exposure():
    values = report(made_up())
    assert values["estimate"]["depth_rms_mm"] == pytest.approx(0.1)
    assert values["belief"]["depth_bias_mm"] == pytest.approx(0.1)
    assert values["belief"]["normal_rms_deg"] == pytest.approx(np.degrees(0.01))
    assert values["belief"]["nis_per_dof"] == 2.0 and values["belief"]["refused"] == 0
    assert values["belief"]["depth_in_2_sigma"] == 1.0


def test_depth_and_alignment_are_held_against_the_reference_in_force_at_their_time():
    record = made_up()
    following = np.flatnonzero(record.command.phase == "follow")
    late = following[len(following) // 2 :]
    record.command.reference[late, 2] += 0.0004
    record.command.reference[late, 3] += 0.02
    depths, angles = [0.2, -0.2], [np.degrees(0.02), 0.0]
    values = report(record)
    assert values["depth_bias_mm"] == pytest.approx(np.mean(depths), abs=0.01)
    assert values["depth_rms_mm"] == pytest.approx(0.2) and values["depth_max_mm"] == pytest.approx(0.2)
    assert values["normal_rms_deg"] == pytest.approx(np.sqrt(np.mean(np.square(angles))), rel=0.01)


def test_quality_is_that_of_the_phase_in_which_the_task_works():
    record = made_up()
    record.command.phase = np.where(record.command.phase == "follow", "track", record.command.phase)
    assert np.isnan(report(record)["depth_rms_mm"])
    record.work = "track"
    values = report(record)
    assert values["depth_rms_mm"] == pytest.approx(0.2)
    assert values["work_s"] == pytest.approx(5.0, abs=0.1)


def test_contact_lost_for_a_quarter_of_the_path_counts():
    record = made_up()
    following = np.flatnonzero(record.phase_at(record.truth.stamp_ns) == "follow")
    record.truth.in_contact[following[: len(following) // 4]] = False
    assert report(record)["contact_fraction"] == pytest.approx(0.75, abs=0.01)


def test_latency_is_that_of_the_command_and_of_each_stage():
    values = report(made_up())["latency_ms"]
    assert values["max"] == pytest.approx(10.0, rel=0.01)
    assert values["stages"]["estimator"]["max"] == pytest.approx(values["max"] / 2)
    assert values["p50"] < values["p99"] <= values["max"]


def test_an_oscillation_is_found_with_amplitude_and_frequency():
    found = report(made_up(wobble=0.00005, wobble_hz=3.0))["oscillation"]
    assert found["depth_mm"] == pytest.approx(0.05, rel=0.15)
    assert found["depth_hz"] == pytest.approx(3.0, abs=0.3)
    assert report(made_up())["oscillation"]["depth_mm"] < 1e-6


def test_a_slow_trend_is_no_oscillation():
    stamps = np.arange(600) * PERIOD_NS
    seconds = stamps * 1e-9
    assert strongest_sinusoid(stamps, 0.3 * seconds + 0.05 * seconds**2)[0] < 1e-6


def test_the_deviation_of_depth_is_that_of_the_sampled_depths():
    rng = np.random.default_rng(1)
    X_sf = se3.inverse(se3.pose_from_euler(np.array([0.002, -0.001, 0.003, 0.3, -0.2, 0.1])))
    half = rng.standard_normal((6, 6)) * 1e-4
    cov = half @ half.T
    sampled = [
        se3.inverse(se3.exp(eps) @ X_sf)[2, 3] for eps in rng.multivariate_normal(np.zeros(6), cov, size=4000)
    ]
    expected = euler_sigmas(GaussianSeries([0], X_sf[None], cov[None]))[0, 2]
    assert np.std(sampled) == pytest.approx(expected, rel=0.05)


def flattened(values, prefix=""):
    for name, value in values.items():
        if isinstance(value, dict):
            yield from flattened(value, f"{prefix}{name}.")
        else:
            yield prefix + name


def test_the_report_has_the_documented_names_and_no_others(tmp_path):
    record = made_up()
    n = len(record.belief)
    record.force = ForceSeries(
        record.belief.stamp_ns, np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)), np.ones(n)
    )
    record.settings = {"controller": {"force.normal": 2.0}}
    values = written(record, tmp_path / "report.json")
    read = json.loads((tmp_path / "report.json").read_text())
    assert read == {**values, "settings": record.settings, "origin": {}}
    patterns = {name: re.compile(re.escape(name).replace(r"\*", "[a-z_0-9]+")) for name in REPORT_FIELDS}
    names = list(flattened(values))
    for name in names:
        assert any(pattern.fullmatch(name) for pattern in patterns.values()), f"{name} is not documented"
    for documented, pattern in patterns.items():
        assert any(pattern.fullmatch(name) for name in names), f"{documented} is not in the report"


def test_a_run_without_truth_gives_null_not_a_number_of_nothing(tmp_path):
    record = made_up()
    record.truth = TruthSeries()
    values = written(record, tmp_path / "report.json")
    assert values["depth_rms_mm"] is None and values["belief"]["depth_rms_mm"] is None
    assert values["latency_ms"]["p50"] is not None
    assert ("depth RMS about reference", "unknown", "<= 0.3 mm") in summary({"arm": record}, {"arm": values})


def test_a_run_without_a_reference_gives_null_for_what_is_measured_against_one(tmp_path):
    record = made_up()
    record.command.reference[:] = np.nan  # as where a task ends before its first belief
    values = written(record, tmp_path / "report.json")
    against = ("depth_rms_mm", "depth_bias_mm", "depth_max_mm", "normal_rms_deg", "depth_overshoot_mm")
    assert [values[name] for name in against] == [None] * len(against)
    assert values["contact_fraction"] == 1.0


def test_an_empty_record_can_be_reported(tmp_path):
    values = written(RunRecord(task="surface_following"), tmp_path / "report.json")
    assert values["contact_fraction"] is None and values["succeeded"] is False


def without_some(record, stage, count):
    """The record with `count` frames in the middle missing from a stage."""
    series = record.latency[stage]
    keep = np.ones(len(series.stamp_ns), bool)
    keep[50 : 50 + count] = False
    record.latency[stage] = StageSeries(series.stamp_ns[keep], series.seconds[keep])
    return record


def test_a_frame_that_no_stage_counts_is_lost_in_silence():
    assert report(made_up())["frames"]["silent"] == 0
    assert report(without_some(made_up(), "controller", 3))["frames"]["silent"] == 3


def test_a_counted_frame_is_not_lost_in_silence():
    record = without_some(made_up(), "controller", 3)
    record.latency["controller"].dropped[-1:] = 2
    assert report(record)["frames"]["silent"] == 1


def test_frames_lost_while_nodes_start_are_told_apart_from_those_lost_at_work():
    record = made_up()
    at_work = np.flatnonzero(record.command.phase == "follow")
    record.latency["controller"].dropped[2:] += 5
    assert report(record)["frames"]["lost"]["controller"] == 5
    assert report(record)["frames"]["lost_at_work"] == 0
    record.latency["controller"].dropped[at_work[10] :] += 2
    frames = report(record)["frames"]
    assert frames["lost"] == {"estimator": 0, "controller": 7} and frames["lost_at_work"] == 2
