"""Bags that lack something or hold something odd: what can be replayed is, and the rest is named."""

import dataclasses

import numpy as np
import pytest
from replay_bags import (
    START_NS,
    STEP_NS,
    STORE,
    TRANSFORMS,
    Recording,
    T_base_sensor,
    believed,
    header,
    make,
    measured,
    pose,
    recording,
    serialized,
    transform,
)
from rosbags.rosbag2 import StoragePlugin

from tactile_filter.bayes_filter import BeliefFlag, FilterSettings
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian
from tactile_geometry.transform_buffer import TransformBuffer
from tactile_records.bags.message_columns import ColumnReader
from tactile_records.replay.inputs import read_inputs
from tactile_records.replay.run import run_filter
from tactile_records.replay.topics import ReplayError
from tactile_wire.message_definitions import type_fields


def replayed(source, folder, **options):
    inputs = read_inputs(source.write(folder), **options)
    return inputs, [run_filter(arm, FilterSettings()) for arm in inputs.arms]


def stamps(run) -> list[int]:
    return [belief.stamp_ns for belief in run.beliefs if belief.valid]


def means(beliefs) -> list[list[float]]:
    return [belief.mean.tolist() for belief in beliefs if belief.valid]


def test_without_static_transforms_the_arms_own_report_is_taken_and_it_is_said(tmp_path):
    source = recording(30).without("/tf_static")
    with pytest.raises(ReplayError, match=r"arm cannot be replayed: .*the bag has no messages on /tf_static"):
        read_inputs(source.write(tmp_path / "bag"))
    kind = "geometry_msgs/msg/PoseStamped"
    for k in range(30):
        stamp_ns = START_NS + k * STEP_NS
        T = T_base_sensor(k * STEP_NS * 1e-9)
        source.add("/arm/arm/pose", kind, make(kind, header(stamp_ns, "arm/base"), pose(T)), stamp_ns)
    inputs, (run,) = replayed(source, tmp_path / "with_pose")
    assert any("the sensor's poses are those of arm/pose" in remark for remark in inputs.arms[0].remarks)
    assert "no messages on /tf_static" in inputs.remarks
    np.testing.assert_allclose(means(run.beliefs), means(believed(recording(30))), atol=1e-12)


def test_without_transforms_an_arm_is_named_and_the_others_are_replayed(tmp_path):
    source = recording(20, arms=("left", "right"))
    tool = [m for m in source.messages if m[0] == "/tf" and b"right/tool" in m[2]]
    source.messages = [m for m in source.messages if m not in tool]
    inputs, (run,) = replayed(source, tmp_path / "bag")
    assert [arm.name for arm in inputs.arms] == ["left"] and len(run.beliefs) == 20
    assert any("right cannot be replayed" in r and "'right/base'" in r for r in inputs.remarks)


def test_another_frame_in_which_the_surface_stands_still_can_be_named(tmp_path):
    source = recording(20)
    T_world_base = se3.exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    source.transforms("/tf_static", START_NS, transform(0, "table", "arm/base", T_world_base))
    _, (run,) = replayed(source, tmp_path / "bag", base_frame="table")
    np.testing.assert_allclose(means(run.beliefs), means(believed(source)), atol=1e-12)
    with pytest.raises(ReplayError, match=r"frame 'tisch' is unknown; known: arm/base, arm/tactile_sensor"):
        read_inputs(tmp_path / "bag", base_frame="tisch")


def test_without_presence_every_estimate_counts_as_one_in_contact(tmp_path):
    source = recording(30)
    inputs, (run,) = replayed(source.without("/arm/contact/presence"), tmp_path / "bag")
    assert inputs.arms[0].remarks == ["no contact/presence: every estimate counts as one in contact"]
    assert means(run.beliefs) == means(believed(source))


def test_estimates_without_a_pose_of_the_sensor_are_passed_over_and_counted(tmp_path):
    source = recording(30, touching=lambda k: True)
    last = START_NS + 25 * STEP_NS
    source.messages = [m for m in source.messages if m[0] != "/tf" or m[3] - source.late_ns < last]
    inputs, (run,) = replayed(source, tmp_path / "bag")
    assert stamps(run) == [START_NS + k * STEP_NS for k in range(25)]
    assert (
        inputs.arms[0].remarks[0].startswith("5 estimates have no pose of the sensor, the first: transform")
    )


def test_between_transforms_poses_are_interpolated_as_by_the_live_buffer(tmp_path):
    """The transforms are of other stamps than the estimates, and out of order."""
    source = recording(40, touching=lambda k: True)
    source.messages = [
        m
        for k, m in enumerate(source.messages)
        if m[0] != "/tf" or (m[3] - source.late_ns - START_NS) % STEP_NS
    ]
    source.move(START_NS - STEP_NS // 2, T_base_sensor(-0.5e-9 * STEP_NS))
    source.messages.insert(0, source.messages.pop())
    inputs, _ = replayed(source, tmp_path / "bag")
    buffer = TransformBuffer()
    for topic, _, data, _ in source.messages:
        for each in STORE.deserialize_cdr(data, TRANSFORMS).transforms if topic.startswith("/tf") else ():
            point, q = each.transform.translation, each.transform.rotation
            T = np.eye(4)
            T[:3, :3] = se3.rotation_from_quaternion((q.x, q.y, q.z, q.w))
            T[:3, 3] = point.x, point.y, point.z
            stamp_ns = each.header.stamp.sec * 10**9 + each.header.stamp.nanosec
            static = topic == "/tf_static"
            buffer.set_transform(each.header.frame_id, each.child_frame_id, stamp_ns, T, static=static)
    assert len(inputs.arms[0].measurements) == 40
    for measurement in inputs.arms[0].measurements:
        expected = buffer.lookup("arm/base", "arm/tactile_sensor", measurement.stamp_ns)
        assert (measurement.T_base_sensor == expected).all()


def joined(*parts):
    """Recordings one after the other, as one."""
    return dataclasses.replace(parts[0], messages=[m for part in parts for m in part.messages])


@pytest.mark.parametrize("first", ["/tf", "/arm/contact/estimate", "/arm/contact/presence"])
def test_where_the_clock_goes_back_the_filter_starts_anew(tmp_path, first):
    """Whatever topic shows the jump first, and though its stamps come twice."""
    before, after = recording(30, touching=lambda k: True), recording(20, touching=lambda k: True)
    early = next(m for m in after.messages if m[0] == first)
    after.messages.remove(early)
    last = max(k for k, m in enumerate(before.messages) if m[0] == first)
    before.messages.insert(last + 1, early)
    inputs, (run,) = replayed(joined(before, after), tmp_path / "bag")
    assert len(inputs.remarks) == 1 and "the clock went back by 0." in inputs.remarks[0]
    assert means(run.beliefs) == means(believed(before)) + means(
        believed(recording(20, touching=lambda k: True))
    )
    assert run.beliefs[30].flags & BeliefFlag.REINITIALIZED and run.resets == {"time jumped back": 1}


def test_where_the_clock_jumps_ahead_the_belief_is_given_up(tmp_path):
    later = START_NS + 3_600_000_000_000
    parts = recording(20, touching=lambda k: True), recording(20, later, touching=lambda k: True)
    inputs, (run,) = replayed(joined(*parts), tmp_path / "bag")
    assert inputs.remarks == [] and len(stamps(run)) == 40
    assert (
        run.beliefs[20].flags & BeliefFlag.REINITIALIZED and "no measurement fused" in run.beliefs[20].reason
    )


def test_of_equal_stamps_the_first_counts_and_the_others_are_named(tmp_path):
    source = recording(20, touching=lambda k: True)
    twice = START_NS + 7 * STEP_NS
    source.estimate(twice, measured(1.0, np.random.default_rng(0)))
    source.presence(twice, False)
    extra = [source.messages.pop(), source.messages.pop()]
    source.messages[45:45] = extra
    inputs, (run,) = replayed(source, tmp_path / "bag")
    assert means(run.beliefs) == means(believed(recording(20, touching=lambda k: True)))
    assert inputs.arms[0].remarks == ["2 messages have the stamp of one before them and are passed over"]


def test_estimates_that_are_none_are_predictions_and_foreign_ones_are_passed_over(tmp_path):
    source = recording(20, touching=lambda k: True)
    random, broken = np.random.default_rng(0), {3: np.nan, 5: -1.0}
    for number, value in broken.items():
        place = [k for k, m in enumerate(source.messages) if m[0] == "/arm/contact/estimate"][number]
        part = recording(1)
        gaussian = measured(0.0, random)
        part.estimate(START_NS + number * STEP_NS, PoseGaussian(gaussian.mean, np.diag([value] * 6)))
        source.messages[place] = part.messages[-1]
    source.estimate(START_NS + 20 * STEP_NS, measured(0.3, random), frame="camera")
    inputs, (run,) = replayed(source, tmp_path / "bag")
    flags = [belief.flags for belief in run.beliefs]
    assert [k for k, flag in enumerate(flags) if flag & BeliefFlag.PREDICTED_ONLY] == [3, 5]
    assert inputs.arms[0].remarks[0].startswith("2 estimates are not finite or no Gaussians")
    assert "1 estimates are not in frame 'arm/tactile_sensor' and are passed over" in inputs.arms[0].remarks
    assert run.rejections == {"not usable": 2}


def test_transforms_and_messages_that_are_none_are_named(tmp_path):
    source = recording(20, touching=lambda k: True)
    bad = transform(START_NS, "arm/base", "arm/tool", np.eye(4))
    bad.transform.rotation.w = 0.9
    source.transforms("/tf", START_NS + 1, bad)
    source.messages.append(
        ("/tf", TRANSFORMS, serialized(make(TRANSFORMS, [bad]), TRANSFORMS)[:50], START_NS)
    )
    source.messages.append(
        ("/arm/contact/presence", "tactile_msgs/msg/ContactPresence", b"\x00\x01\x00", START_NS)
    )
    inputs, (run,) = replayed(source, tmp_path / "bag")
    assert means(run.beliefs) == means(believed(recording(20, touching=lambda k: True)))
    assert any("/tf: 1 transforms of 'arm/tool' are none" in remark for remark in inputs.remarks)
    assert any(r.startswith("/tf: 1 messages cannot be decoded, the first: tf2_msgs") for r in inputs.remarks)
    assert "/arm/contact/presence: 1 messages cannot be decoded" in inputs.arms[0].remarks[0]


def test_a_static_transform_that_changes_is_named(tmp_path):
    source = recording(10)
    source.transforms("/tf_static", START_NS, transform(0, "arm/tool", "arm/tactile_sensor", np.eye(4)))
    inputs, _ = replayed(source, tmp_path / "bag")
    assert "'arm/tactile_sensor' changes during the recording" in inputs.remarks[0]


@pytest.mark.parametrize("as_written", ["mcap", "sqlite"])
def test_of_a_truncated_bag_what_is_readable_is_replayed(tmp_path, as_written):
    source = recording(600)
    if as_written == "mcap":
        folder = source.write_as_ros2_bag(tmp_path / "bag", StoragePlugin.MCAP)
    else:
        folder = source.write_as_ros2_bag(tmp_path / "bag")
    file = next(path for path in folder.iterdir() if path.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[: int(0.6 * file.stat().st_size)])
    inputs = read_inputs(folder)
    run = run_filter(inputs.arms[0], FilterSettings())
    assert inputs.remarks[0].startswith("bag not complete: ") and "ends early" in inputs.remarks[0]
    assert 50 < len(stamps(run)) < 595
    expected = {belief.stamp_ns: belief for belief in believed(source)}
    whole = [b for b in run.beliefs if b.valid][:50]  # behind a hole in the file beliefs are others
    assert means(whole) == [expected[belief.stamp_ns].mean.tolist() for belief in whole]


# ---- columns ----


def test_columns_are_the_numbers_of_the_messages():
    """Messages with strings and sequences of several lengths, in both byte orders."""
    messages = []
    for k in range(40):
        T = se3.exp(0.1 * np.arange(6) * k)
        parts = [transform(START_NS + k, f"{'x' * (k % 5)}base", f"tool{n}", T) for n in range(k % 3)]
        messages.append(make(TRANSFORMS, parts))
    data = [
        bytes(STORE.serialize_cdr(m, TRANSFORMS, little_endian=k % 4 > 0)) for k, m in enumerate(messages)
    ]
    data.insert(11, data[20][:37])
    messages.insert(11, None)
    reader = ColumnReader(type_fields(TRANSFORMS), TRANSFORMS)
    seen = []
    for columns in reader.read(data):
        seen += columns.indices.tolist()
        for row, index in enumerate(columns.indices.tolist()):
            assert columns.layout.lengths["transforms"] == len(messages[index].transforms)
            for n, each in enumerate(messages[index].transforms):
                assert columns.layout.texts[f"transforms.{n}.child_frame_id"] == each.child_frame_id
                assert (
                    columns.values[f"transforms.{n}.transform.rotation.w"][row] == each.transform.rotation.w
                )
                stamp = columns.stamps_ns(f"transforms.{n}.header.stamp")[row]
                assert stamp == START_NS + index - (index > 11)
    assert sorted([*seen, 11]) == list(range(41)) and reader.unreadable[0][0] == 11


def inserted(source, part, at: int) -> None:
    """Put the last message of another recording among those of a source, as received there."""
    topic, kind, data, _ = part.messages[-1]
    source.messages.insert(at, (topic, kind, data, source.messages[at - 1][3]))


def test_what_live_nodes_refuse_of_lies_changes_no_belief_and_is_named(tmp_path):
    source, lie = recording(60, touching=lambda k: True), recording(1)
    expected = means(believed(source))
    for at, k in ((200, 35), (120, 20), (60, 10)):
        stamp_ns = START_NS + k * STEP_NS + STEP_NS // 4
        lie.move(stamp_ns, se3.exp([0.14, 0.0, 0.0, 0.0, 0.0, 0.0]) @ T_base_sensor(k * STEP_NS * 1e-9))
        inserted(source, lie, at)
        lie.transforms("/tf", 0, transform(stamp_ns - k * 10**9, "map", "drone", np.eye(4)))
        inserted(source, lie, at)
        lie.move(stamp_ns + 100 * 10**9, np.eye(4))
        inserted(source, lie, at)
        lie.estimate(stamp_ns + 100 * 10**9, measured(0.0, np.random.default_rng(0)))
        inserted(source, lie, at)
        lie.presence(stamp_ns, False)
        topic, kind, data, _ = lie.messages[-1]
        lie.messages.append((topic, kind, data.replace(b"arm/", b"ARM/"), 0))
        inserted(source, lie, at)
    inputs, (run,) = replayed(source, tmp_path / "bag")
    assert means(run.beliefs) == expected
    assert inputs.remarks == [
        "/tf: 3 transforms of 'arm/tool' are stamped ahead of the clock and passed over",
        "/tf: 3 transforms of 'arm/tool' jumped and are passed over",
    ]
    assert inputs.arms[0].remarks == [
        "/arm/contact/estimate: 3 messages are stamped ahead of the clock and passed over",
        "3 presences are not in frame 'arm/tactile_sensor'",
    ]


def test_where_the_arm_jumped_and_stayed_the_filter_starts_anew_and_no_pose_lies_between(tmp_path):
    source, away = Recording(), se3.exp([0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
    source.static()
    random = np.random.default_rng(1)
    for k in range(100):
        stamp_ns, seconds = START_NS + k * STEP_NS, k * STEP_NS * 1e-9
        T = T_base_sensor(seconds) if k < 30 else away @ T_base_sensor(seconds)
        source.move(stamp_ns - 1000, T)
        source.move(stamp_ns + 1000, T)
        source.estimate(stamp_ns, measured(seconds, random))
        source.presence(stamp_ns, True)
    inputs, (run,) = replayed(source, tmp_path / "bag")
    assert len(inputs.remarks) == 1
    assert "'arm/base' -> 'arm/tool' jumped by 20" in inputs.remarks[0]
    assert inputs.remarks[0].endswith("and stayed there: the filter starts anew there")
    assert [k for k, b in enumerate(run.beliefs) if b.flags & BeliefFlag.REINITIALIZED] == [0, 30]
    y = [measurement.T_base_sensor[0, 3] for measurement in inputs.arms[0].measurements]
    assert np.flatnonzero(np.abs(np.diff(y)) > 0.01).tolist() == [29]
    assert y[30] - y[29] > 0.199
