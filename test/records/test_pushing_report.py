"""The report of a push: distances known beforehand, what it says without a truth, and its pictures."""

import dataclasses

import numpy as np
import pytest

from tactile_geometry import se3
from tactile_records.runs import pushing
from tactile_records.runs.record import (
    BeliefSeries,
    BodySeries,
    CommandSeries,
    LooseBody,
    PoseSeries,
    RunRecord,
    TruthSeries,
)
from tactile_records.runs.report import REPORTS, summary, write_numbers, write_pictures
from tactile_records.runs.surfaces import loose_outline, surface_mesh
from tactile_scene.scene_file import load_scene

ROWS, WORKING = 60, slice(10, 55)
DEPTH = 0.004
SQUARE = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]]) * 0.05
T_WORLD_BASE = se3.pose_from_euler([0.1, 0.2, 0.0, 0.0, 0.0, np.pi / 2])


def facing(x, y, heading):
    """A sensor (4, 4) whose axis lies in the floor's plane, `heading` rad from the world's x, its x down."""
    T = np.eye(4)
    T[:3, 2] = np.cos(heading), np.sin(heading), 0.0
    T[:3, 0] = 0.0, 0.0, -1.0
    T[:3, 1] = np.cross(T[:3, 2], T[:3, 0])
    T[:3, 3] = x, y, 0.045
    return T


def made_up(tilted=0.0, arm="leader", task="pushing", beside=0.0):
    """Pushes along the world's x for 0.3 m; the normal leans by `tilted` rad to the left of the axis."""
    stamps = np.arange(ROWS) * 16_666_667
    along = np.linspace(0.0, 0.3, ROWS)
    T_world = np.array([facing(x, beside, 0.0) for x in along])
    X_fs = se3.pose_from_euler([0.0, 0.0, DEPTH, 0.0, 0.0, 0.0])
    X_fs[:3, :3] = se3.pose_from_euler([0, 0, 0, tilted, 0, 0])[:3, :3]  # about x, which points down
    X_fs = np.tile(X_fs, (ROWS, 1, 1))
    body = np.tile(np.eye(4), (ROWS, 1, 1))
    body[:, 0, 3] = along + 0.066
    phase = np.full(ROWS, "approach", dtype="U16")
    phase[WORKING], phase[WORKING.stop :] = "push", "retreat"
    work = "push" if task == "pushing" else "track"
    phase = np.where(phase == "push", work, phase)
    cov = np.tile(np.eye(6) * 1e-8, (ROWS, 1, 1))
    reference = np.where((phase == work)[:, None], [0.0, 0.0, 0.003, 0.0, 0.0, 0.0], np.nan)
    return RunRecord(
        scene="pushing",
        task=task,
        arm=arm,
        work=work,
        goals=["push"],
        targets=np.array([(np.linalg.inv(T_WORLD_BASE) @ [0.35, 0.01, 0.045, 1.0])[:3]]),
        T_world_base=T_WORLD_BASE,
        pose=PoseSeries(stamps, se3.inverse(T_WORLD_BASE) @ T_world),
        truth=TruthSeries(stamps, X_fs, np.zeros(ROWS), np.ones(ROWS, bool)),
        belief=BeliefSeries(stamps, np.linalg.inv(X_fs), cov),
        command=CommandSeries(stamps, np.zeros((ROWS, 6)), phase=phase, reference=reference),
        body=BodySeries(stamps, body),
        loose=LooseBody(np.column_stack([SQUARE, np.zeros(5)]), body[0]),
        result={"succeeded": True, "reason": "", "wall_s": 1.0},
    )


END_X = np.linspace(0.0, 0.3, ROWS)[WORKING.stop - 1] * 1e3  # mm


def push(record, run=None):
    return pushing.numbers(record, run or {record.arm: record})["push"]


def test_the_error_is_the_perpendicular_distance_of_the_target_from_the_contact_normal():
    assert push(made_up())["error_mm"] == pytest.approx(10.0, abs=1e-9)  # the target lies 10 mm to the left
    leaning = push(made_up(tilted=0.1))
    ahead = 350.0 - END_X
    assert leaning["error_mm"] == pytest.approx(10.0 * np.cos(0.1) - ahead * np.sin(0.1), abs=1e-9)
    assert leaning["error_axis_mm"] == pytest.approx(10.0, abs=1e-9)


def test_a_target_on_the_right_has_the_other_sign_and_the_same_size():
    found = push(made_up(beside=0.025))
    assert found["error_mm"] == pytest.approx(-15.0, abs=1e-9)
    assert found["error_abs_mm"] == pytest.approx(15.0, abs=1e-9)


@pytest.mark.parametrize("degrees", [-120.0, -10.0, 0.0, 30.0])
def test_the_angle_to_the_goals_direction_is_positive_where_the_axis_points_to_its_left(degrees):
    record = made_up()  # its axis points along the world's x
    assert push(record)["direction_error_deg"] is None
    wanted = 2.5 * np.array([np.cos(np.radians(degrees)), -np.sin(np.radians(degrees)), 0.0])
    record.directions = (T_WORLD_BASE[:3, :3].T @ wanted)[None]
    assert push(record)["direction_error_deg"] == pytest.approx(degrees, abs=1e-9)
    rows = dict(row[:2] for row in pushing.summary(pushing.numbers(record, {record.arm: record})))
    assert rows["from the goal's direction"] == f"{degrees:.1f} deg"


def test_the_error_is_that_of_the_end_of_the_push_and_not_of_the_retreat():
    assert push(made_up())["distance_mm"] == pytest.approx(np.hypot(350.0 - END_X, 10.0), abs=1e-9)


def test_belief_and_truth_are_told_apart():
    record = made_up(tilted=0.1)
    record.belief.mean[:] = se3.inverse(se3.pose_from_euler([0.0, 0.0, DEPTH, 0.0, 0.0, 0.0]))
    found = push(record)
    assert found["error_believed_mm"] == pytest.approx(10.0, abs=1e-9)
    assert found["error_mm"] == found["error_true_mm"] != found["error_believed_mm"]


def test_a_real_push_is_reported_by_belief_with_an_indicative_body():
    record = made_up(tilted=0.1)
    true_error, true_body = push(record)["error_mm"], record.body.T_world_body[WORKING]
    record.truth, record.body = TruthSeries(), BodySeries()
    found = push(record)
    assert found["error_mm"] == pytest.approx(true_error, abs=1e-9)
    assert found["error_true_mm"] is np.nan or np.isnan(found["error_true_mm"])
    assert found["toppled"] is None
    _, T, true = pushing.body_poses(record)
    assert not true
    moved = T[:, :3, 3] - T[0, :3, 3]  # a contact that sticks takes the body along
    np.testing.assert_allclose(moved, true_body[:, :3, 3] - true_body[0, :3, 3], atol=1e-9)


def test_a_push_that_ended_before_its_target_says_how_far_from_it():
    record = made_up()
    record.result = {"succeeded": False, "reason": "no contact"}
    rows = dict(row[:2] for row in pushing.summary(pushing.numbers(record, {record.arm: record})))
    assert rows["target to contact normal"] == f"10.00 mm, {np.hypot(350.0 - END_X, 10.0):.0f} mm before it"


def test_a_body_that_falls_has_toppled_and_one_that_turns_has_not():
    record = made_up()
    for k, angle in enumerate(np.linspace(0.0, 0.5, ROWS)):
        record.body.T_world_body[k, :3, :3] = se3.pose_from_euler([0, 0, 0, 0, 0, angle])[:3, :3]
    found = push(record)
    assert not found["toppled"] and found["body_tilt_max_deg"] == pytest.approx(0.0, abs=1e-5)
    assert found["body_turned_deg"] == pytest.approx(np.degrees(0.5 * 44 / 59), abs=1e-6)
    for k, angle in enumerate(np.linspace(0.0, 1.2, ROWS)):
        record.body.T_world_body[k, :3, :3] = se3.pose_from_euler([0, 0, 0, angle, 0, 0])[:3, :3]
    assert push(record)["toppled"]


def test_the_follower_is_told_of_while_the_leader_pushes():
    leader, follower = made_up(), made_up(arm="follower", task="object_tracking")
    follower.truth.in_contact[:30] = False
    found = push(leader, {"leader": leader, "follower": follower})
    assert found["follower"] == "follower"
    assert found["follower_contact_fraction"] == pytest.approx(25 / 45)
    assert found["follower_depth_rms_mm"] == pytest.approx(1.0)


def test_numbers_summary_and_pictures_of_both_arms(tmp_path):
    run = {"leader": made_up(), "follower": made_up(arm="follower", task="object_tracking", beside=0.1)}
    values = write_numbers(run, "leader", tmp_path / "report.json")
    assert {f"push.{name}" for name in values["push"]} <= REPORTS.load("pushing").fields.keys()
    rows = {name: value for name, value, _ in summary(run, {"leader": values})}
    assert rows["leader: target to contact normal"] == "10.00 mm" and rows["leader: toppled"] == "no"
    for path in write_pictures(run, "leader", tmp_path):
        assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
        assert path.stat().st_size > 20_000 or not path.name.startswith("push")


@pytest.mark.parametrize("record", [RunRecord(task="pushing", work="push")])
def test_a_run_that_came_to_nothing_gives_pictures_that_say_so_and_numbers_that_are_missing(tmp_path, record):
    assert len(write_pictures({"arm": record}, "arm", tmp_path)) == 4
    values = write_numbers({"arm": record}, "arm", tmp_path / "report.json")
    assert values["push"]["error_mm"] is None and values["push"]["toppled"] is None


def test_the_record_of_a_push_survives_saving_and_loading(tmp_path):
    record = made_up()
    record.save(tmp_path / "run.npz")
    loaded = RunRecord.load(tmp_path / "run.npz")
    assert push(loaded) == push(record)
    np.testing.assert_array_equal(loaded.loose.outline, record.loose.outline)


def test_the_outline_of_a_loose_body_is_the_cut_at_the_sensors_height():
    scene = load_scene("tracking_cube")
    found = loose_outline(scene, "follower")
    assert len(surface_mesh(scene, "follower").vertices)
    distance = scene.bodies["cube"].make().distance(found.outline)
    np.testing.assert_allclose(distance, 0.0, atol=1e-9)
    assert np.abs(found.outline[:, :2]).max() == pytest.approx(0.0285, abs=1e-6)
    still = dataclasses.replace(
        scene, bodies={"cube": dataclasses.replace(scene.bodies["cube"], motion="carried")}
    )
    assert not len(loose_outline(still, "follower").outline)
