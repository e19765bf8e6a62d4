"""A replayed bag gives the beliefs that the live filter has, to the bit, and the same bytes every time."""

import json
import os
import random
import re
import subprocess
import sys
import time

import numpy as np
import pytest
import replay_bags as bags
from clusters import local_cluster
from replay_bags import START_NS, STEP_NS, believed, recording
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from tactile_bringup.cli import main
from tactile_filter.bayes_filter import BeliefFlag, FilterSettings
from tactile_filter.belief import invalid_belief
from tactile_filter.force import ForceFilter, ForceGaussian, ForceSettings
from tactile_records.bags.contents import Gap
from tactile_records.bags.reader import read_bag
from tactile_records.replay.inputs import read_inputs
from tactile_records.replay.kept import KeptRuns, Plan
from tactile_records.replay.report import RunResult
from tactile_records.replay.run import Agreement, agreement, run_filter
from tactile_records.replay.sweep import SINGLE, make_plans
from tactile_records.replay.topics import ReplayError
from tactile_records.runs.export import tables
from tactile_records.runs.from_bag import run_from_bag
from tactile_records.runs.metrics import report
from tactile_records.runs.record import BeliefSeries, CommandSeries


def replayed(folder, settings=None, **options):
    """The runs of all arms of a bag."""
    inputs = read_inputs(folder)
    return inputs, [run_filter(arm, settings or FilterSettings(), **options) for arm in inputs.arms]


def same(beliefs, others) -> bool:
    valid = [belief for belief in beliefs if belief.valid]
    return len(valid) == len(others) and all(
        a.stamp_ns == b.stamp_ns
        and (a.mean == b.mean).all()
        and (a.cov == b.cov).all()
        and (a.nis == b.nis or np.isnan([a.nis, b.nis]).all())
        and a.flags == b.flags
        for a, b in zip(valid, others, strict=True)
    )


def with_live(source, settings=None, skip=()):
    """The recording with what the live filter published."""
    for belief in believed(source, settings, skip=skip):
        source.state(belief)
    return source


def test_beliefs_are_those_of_the_live_filter_to_the_bit(tmp_path):
    source = recording()
    inputs, (run,) = replayed(source.write(tmp_path / "bag"))
    assert same(run.beliefs, believed(source)) and len(run.beliefs) == 60
    assert inputs.remarks == inputs.arms[0].remarks == []


def test_a_recorded_force_is_filtered_anew_exported_and_reported(tmp_path):
    source, cov, library, wanted = (
        recording(touching=lambda k: k < 20 or k >= 30),
        np.eye(3),
        ForceFilter(),
        [],
    )
    source.note["parameters"] = json.dumps({"/arm/filter": {"force.noise": 3.0}})
    library.configure(ForceSettings(noise=3.0))
    for k in range(60):
        if 20 <= k < 30:
            library.reset()
            continue
        stamp_ns, mean = START_NS + k * STEP_NS, np.array([0.1 * k, 0.0, 5.0])
        source.force(stamp_ns, mean, cov)
        assert library.step(stamp_ns, ForceGaussian(mean, cov)) == ""
        wanted.append((stamp_ns, *library.belief.mean, *library.belief.cov.ravel()))
    assert (
        main(["replay", str(source.write(tmp_path / "bag")), "--out", str(tmp_path / "out"), "--no-plot"])
        == 0
    )
    record = run_from_bag(read_bag(tmp_path / "out" / "replay"), "arm")
    found = np.column_stack([record.force.stamp_ns, record.force.force, record.force.cov.reshape(-1, 9)])
    assert np.array_equal(found, np.array(wanted)) and np.isnan(record.force.nis[[0, 20]]).all()
    table = tables(record)["force"]
    assert table["force_z_n"][0] == 5.0 and table["cov_z_z_n2"][0] == 1.0
    record.command = CommandSeries(np.array([START_NS - 1]), phase=np.array([record.work]))
    numbers = report(record)["force"]
    assert numbers["mean_n"]["z"] == pytest.approx(5.0) and numbers["largest_n"] < 8.0


def test_settings_count(tmp_path):
    source, settings = recording(), FilterSettings(fusion_mode="exact", process_noise_translation=1e-4)
    _, (run,) = replayed(source.write(tmp_path / "bag"), settings)
    assert same(run.beliefs, believed(source, settings)) and not same(run.beliefs, believed(source))


def test_without_contact_there_is_no_belief_and_it_starts_anew_after(tmp_path):
    source = recording(touching=lambda k: 5 <= k < 20 or k >= 40)
    _, (run,) = replayed(source.write(tmp_path / "bag"))
    assert same(run.beliefs, believed(source))
    assert [bool(b.flags & BeliefFlag.NO_CONTACT) for b in run.beliefs] == [True] * 5 + [False] * 15 + [
        True
    ] * 20 + [False] * 20
    assert run.beliefs[40].flags & BeliefFlag.REINITIALIZED and run.resets["no contact"] == 1


def test_the_order_in_which_messages_came_does_not_matter(tmp_path):
    source = recording()
    for seed in range(3):
        by_topic = {}  # the messages of one topic keep their order
        for message in source.messages:
            by_topic.setdefault(message[0], []).append(message)
        topics = [message[0] for message in source.messages]
        random.Random(seed).shuffle(topics)
        end_ns = START_NS + 10_000_000_000
        messages = [(*by_topic[topic].pop(0)[:3], end_ns + k) for k, topic in enumerate(topics)]
        _, (run,) = replayed(bags.Recording(messages).write(tmp_path / f"bag{seed}"))
        assert same(run.beliefs, believed(source))


def test_messages_that_overtook_each_other_are_put_in_their_order(tmp_path):
    source, mixed = recording(touching=lambda k: True), recording(touching=lambda k: True)
    for at in range(1, len(mixed.messages) - 12, 12):
        block = mixed.messages[at : at + 12]  # of less than what is taken for a jump of the clock
        random.Random(at).shuffle(block)
        mixed.messages[at : at + 12] = block
    _, (run,) = replayed(mixed.write(tmp_path / "bag"))
    assert same(run.beliefs, believed(source))


@pytest.mark.parametrize("plugin", StoragePlugin)
@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE])
def test_bags_of_ros2_bag_give_the_same_beliefs(tmp_path, plugin, mode):
    source = recording(20)
    _, (run,) = replayed(source.write_as_ros2_bag(tmp_path / "bag", plugin, mode))
    assert same(run.beliefs, believed(source))


def test_a_bag_without_definitions_is_read_with_the_known_ones(tmp_path):
    """Before Iron, `ros2 bag` kept none."""
    import sqlite3

    source = recording(20)
    folder = source.write_as_ros2_bag(tmp_path / "bag")
    with sqlite3.connect(next(folder.glob("*.db3"))) as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    assert read_bag(folder).definitions == {}
    _, (run,) = replayed(folder)
    assert same(run.beliefs, believed(source))


def test_what_the_live_filter_published_is_what_the_replay_gives(tmp_path):
    source = with_live(recording())
    inputs, (run,) = replayed(source.write(tmp_path / "bag"), as_recorded=False)
    found = agreement(run.states, inputs.arms[0].live)
    assert found == Agreement(common=55, identical=55, only_live=0, only_replayed=5)


STILL = 128  # ContactState.msg's, which is a fact about images and no flag of the filter


@pytest.mark.parametrize("flag, identical", [(STILL, 55), (int(BeliefFlag.GATED), 49)])
def test_that_images_stood_still_is_no_difference_between_beliefs(tmp_path, flag, identical):
    inputs, (run,) = replayed(with_live(recording()).write(tmp_path / "bag"), as_recorded=False)
    inputs.arms[0].live.values["flags"][10:16] |= flag
    assert agreement(run.states, inputs.arms[0].live).identical == identical


def test_by_how_much_unlikely_estimates_were_inflated_is_part_of_what_is_compared(tmp_path):
    settings = FilterSettings(robust="student_t")
    inputs, (run,) = replayed(with_live(recording(), settings).write(tmp_path / "bag"), settings)
    assert agreement(run.states, inputs.arms[0].live).identical == 55
    assert run.states["inflation"].tolist() == [belief.inflation for belief in run.beliefs]
    assert len(set(run.states["inflation"][6:])) > 40


def test_a_bag_of_a_version_that_had_no_such_field_is_compared_in_what_it_has(tmp_path):
    inputs, (run,) = replayed(with_live(recording()).write(tmp_path / "bag"))
    live = inputs.arms[0].live
    live.values = live.values[[name for name in live.values.dtype.names if name != "inflation"]]
    assert agreement(run.states, live).identical == 55


def test_events_that_the_live_filter_dropped_are_left_out_unless_asked_for(tmp_path):
    dropped = {START_NS + k * STEP_NS for k in (20, 21, 30)}
    source = with_live(recording(touching=lambda k: True), skip=dropped)
    folder = source.write(tmp_path / "bag")
    inputs, (run,) = replayed(folder)
    assert run.left_out == 3 and same(run.beliefs, believed(source, skip=dropped))
    assert agreement(run.states, inputs.arms[0].live) == Agreement(57, 57, 0, 0)
    _, (whole,) = replayed(folder, as_recorded=False)
    assert whole.left_out == 0 and same(whole.beliefs, believed(source))


def test_beliefs_after_one_whose_inputs_were_lost_are_not_compared_until_the_contact_ends(tmp_path):
    touching = lambda k: k % 20 >= 5  # noqa: E731
    source = recording(60, touching=touching)
    nowhere = [
        invalid_belief(START_NS + k * STEP_NS, BeliefFlag.NO_CONTACT) for k in range(60) if not touching(k)
    ]
    for belief in sorted([*believed(source), *nowhere], key=lambda belief: belief.stamp_ns):
        source.state(belief)
    lost_ns = START_NS + 30 * STEP_NS
    received_ns = lost_ns + source.late_ns
    source.messages = [m for m in source.messages if m[0] == "/arm/contact/state" or m[3] != received_ns]
    source.gaps = [Gap("/arm/contact/estimate", 1, lost_ns - STEP_NS, lost_ns + STEP_NS)]
    inputs, (run,) = replayed(source.write(tmp_path / "bag"))
    found = agreement(run.states, inputs.arms[0].live)
    assert found == Agreement(50, 50, only_live=1, only_replayed=0, after_gap=9)
    (remark,) = inputs.remarks
    assert (
        "bag not complete: /arm/contact/estimate: 1 of 45 messages were published and not recorded" in remark
    )
    assert f"between {(lost_ns - STEP_NS) / 1e9:.3f} and {(lost_ns + STEP_NS) / 1e9:.3f} s" in remark


def test_a_single_bit_that_differs_is_found(tmp_path):
    source = with_live(recording(touching=lambda k: True))
    inputs, (run,) = replayed(source.write(tmp_path / "bag"))
    values = inputs.arms[0].live.values = inputs.arms[0].live.values.copy()
    values["xi"][17, 2] = np.nextafter(values["xi"][17, 2], 1.0)
    found = agreement(run.states, inputs.arms[0].live)
    assert (found.common, found.identical) == (60, 59)
    assert found.first_difference == f"xi at {START_NS + 17 * STEP_NS} ns"


def test_every_arm_is_replayed(tmp_path):
    source = recording(30, arms=("left", "right"))
    inputs, runs = replayed(source.write(tmp_path / "bag"))
    assert [arm.name for arm in inputs.arms] == ["left", "right"]
    for name, run in zip(("left", "right"), runs, strict=True):
        assert same(run.beliefs, believed(source, arm=name))


def test_settings_that_were_changed_while_the_filter_ran_are_changed_again(tmp_path, capsys):
    """The live filter believed in exposure k, 8 ms after it, and was changed before it came to k + 1."""
    source = recording(30, touching=lambda k: True)
    start = FilterSettings(process_noise_rotation=0.02)
    first, second = (
        start.replaced(process_noise_rotation=1e-3),
        start.replaced(process_noise_rotation=1e-3, fusion_mode="fast"),
    )
    changes = [(START_NS + 10 * STEP_NS, first), (START_NS + 20 * STEP_NS, second)]
    expected = believed(source, start, changes=changes)
    for belief in expected:
        source.state(belief)
    source.parameter(START_NS, "process_noise_rotation", 0.5, declared=True)
    source.parameter(START_NS + 5 * STEP_NS, "fusion_mode", "exact", arm="other")
    source.parameter(START_NS + 5 * STEP_NS, "inputs.tf_timeout", 0.2)
    source.parameter(START_NS + 9 * STEP_NS + 8_000_001, "process_noise_rotation", 1e-3)
    source.parameter(START_NS + 20 * STEP_NS - 1, "fusion_mode", "fast")
    source.note["parameters"] = json.dumps({"/arm/filter": {"process_noise_rotation": 0.02}})
    bag = source.write(tmp_path / "bag")
    assert replay(bag, tmp_path / "out", "--check") == 0
    text = capsys.readouterr().out
    assert "2 changes of the filter's settings while it ran are followed" in text and "to the bit" in text
    inputs = read_inputs(bag)
    given = make_plans({"arm": start}, ["process_noise_rotation=0.01"], [], tmp_path)[0].given
    followed = [change.without(given) for change in inputs.arms[0].changes]
    run = run_filter(inputs.arms[0], start.replaced(process_noise_rotation=0.01), changes=followed)
    others = [(START_NS + 20 * STEP_NS, start.replaced(process_noise_rotation=0.01, fusion_mode="fast"))]
    assert same(run.beliefs, believed(source, start.replaced(process_noise_rotation=0.01), changes=others))


def test_where_the_live_filter_was_asked_to_start_anew_the_replay_does(tmp_path):
    source = recording(30, touching=lambda k: True)
    asked = START_NS + 12 * STEP_NS
    for belief in believed(source, resets=(asked,)):
        source.state(belief)
    inputs, (run,) = replayed(source.write(tmp_path / "bag"), FilterSettings(max_prediction_age=0.3))
    assert inputs.arms[0].resets == {asked} and run.resets == {"service": 1}
    assert agreement(run.states, inputs.arms[0].live) == Agreement(30, 30, 0, 0)


def test_a_start_anew_after_a_gap_is_the_filters_own(tmp_path):
    source = recording(60, touching=lambda k: True)
    gap = {START_NS + k * STEP_NS for k in range(10, 45)}
    for belief in believed(source, skip=gap):
        source.state(belief)
    inputs, (run,) = replayed(source.write(tmp_path / "bag"))
    assert inputs.arms[0].resets == frozenset() and run.beliefs[10].flags & BeliefFlag.REINITIALIZED
    assert agreement(run.states, inputs.arms[0].live) == Agreement(25, 25, 0, 0)


# ---- the command ----


def replay(bag, out, *options) -> int:
    return main(["replay", str(bag), "--out", str(out), "--no-plot", *options])


def bytes_of(folder) -> dict[str, bytes]:
    """All files but the report, whose means are rounded by where NumPy's arrays lie in memory."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "report.json")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def assert_same_report(one, other) -> None:
    """The reports of two folders say the same, but for rounding."""
    texts = [(folder / "report.json").read_text() for folder in (one, other)]
    number = re.compile(r"-?\d+\.\d+(e-?\d+)?")
    assert number.sub("#", texts[0]) == number.sub("#", texts[1])
    found = [[float(each[0]) for each in number.finditer(text)] for text in texts]
    np.testing.assert_allclose(*found, rtol=1e-10)


def test_the_same_bag_gives_the_same_bytes_on_any_number_of_cores_and_on_a_cluster(tmp_path, capsys):
    bag = with_live(recording(arms=("arm",))).write(tmp_path / "bag")
    sweep = ("--sweep", "fusion_mode=paper,fast,exact", "--sweep", "process_noise_rotation=0.001,0.01")
    for name, jobs in (("a", "1"), ("b", "2"), ("c", "3")):
        assert replay(bag, tmp_path / name, *sweep, "--smooth", "--jobs", jobs) == 0
    first = bytes_of(tmp_path / "a")
    assert len(first) == 6 * 2 and first == bytes_of(tmp_path / "b") == bytes_of(tmp_path / "c")
    for other in ("b", "c"):
        assert_same_report(tmp_path / "a", tmp_path / other)
    states = {data for name, data in first.items() if name.endswith(".mcap")}
    assert len(states) == 6  # the settings make a difference
    with local_cluster() as address:
        assert replay(bag, tmp_path / "d", *sweep, "--smooth", "--scheduler", address) == 0
    assert first == bytes_of(tmp_path / "d")
    assert_same_report(tmp_path / "a", tmp_path / "d")


def test_a_sweep_that_was_killed_goes_on_with_the_runs_that_are_missing(tmp_path, capsys):
    bag = with_live(recording(300, arms=("arm", "other"))).write(tmp_path / "bag")
    sweep = ("--sweep", "iterations=1,2,3,4", "--sweep", "process_noise_rotation=0.001,0.01", "--smooth")
    words = ["replay", str(bag), "--out", str(tmp_path / "killed"), "--no-plot", *sweep]
    script = f"from tactile_bringup.cli import main\nmain({words!r} + ['--jobs', '2'])"
    path = os.pathsep.join(filter(None, sys.path))
    process = subprocess.Popen([sys.executable, "-c", script], env={**os.environ, "PYTHONPATH": path})
    while len(kept := list((tmp_path / "killed").glob(".runs/*.npz"))) < 2:
        assert process.poll() is None
        time.sleep(0.01)
    process.kill()
    process.wait()
    bags = {
        path.stem: (tmp_path / "killed" / path.stem / "metadata.yaml").stat().st_mtime_ns for path in kept
    }
    assert replay(bag, tmp_path / "killed", *sweep, "--jobs", "1") == 0
    assert "of 8 runs are done already" in capsys.readouterr().err
    for name, written_ns in bags.items():
        assert (tmp_path / "killed" / name / "metadata.yaml").stat().st_mtime_ns == written_ns
    assert replay(bag, tmp_path / "whole", *sweep, "--jobs", "1") == 0
    assert bytes_of(tmp_path / "killed") == bytes_of(tmp_path / "whole")
    assert_same_report(tmp_path / "killed", tmp_path / "whole")


def test_runs_of_another_recording_or_setting_are_not_taken(tmp_path):
    plan, other = (Plan(SINGLE, tmp_path / SINGLE, {"arm": FilterSettings(iterations=n)}) for n in (1, 2))
    kept = KeptRuns(tmp_path, {"files": {"a": [1, 2]}})
    kept.keep(plan, [RunResult(SINGLE, "arm", BeliefSeries(), events=3)])
    assert kept.results(plan) is None  # its bag is gone
    plan.bag.mkdir()
    assert [(found.arm, found.events) for found in kept.results(plan)] == [("arm", 3)]
    assert kept.results(other) is None
    assert KeptRuns(tmp_path, {"files": {"a": [1, 3]}}).results(plan) is None
    (file,) = (tmp_path / ".runs").iterdir()
    file.write_bytes(file.read_bytes()[:-9])
    assert kept.results(plan) is None


def test_the_new_bag_is_opened_by_other_readers_and_says_what_it_is_of(tmp_path, capsys):
    bag = recording(30).write(tmp_path / "bag")
    assert replay(bag, tmp_path / "out", "--set", "fusion_mode=fast", "--copy", "inputs", "--smooth") == 0
    with AnyReader([tmp_path / "out" / "replay"]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        state = next(c for c in reader.connections if c.topic == "/arm/contact/state")
        _, received_ns, raw = next(reader.messages([state]))
        message = reader.deserialize(raw, state.msgtype)
    assert counts["/arm/contact/state"] == 30 and counts["/arm/contact/belief"] == 25
    assert counts["/arm/contact/smoothed"] == 25 and counts["/tf"] == 60
    assert message.flags == BeliefFlag.NO_CONTACT | BeliefFlag.INVALID
    assert received_ns == START_NS + 5_000_000  # when its last input had come
    note = read_bag(tmp_path / "out" / "replay").note
    assert note["scene"] == "test" and json.loads(note["replay"])["bag"] == str(bag)
    assert json.loads(note["parameters"])["/arm/filter"]["fusion_mode"] == "fast"


def test_a_replay_can_be_replayed(tmp_path, capsys):
    bag = recording(30).write(tmp_path / "bag")
    assert replay(bag, tmp_path / "one", "--set", "process_noise_translation=2e-3", "--copy", "all") == 0
    assert replay(tmp_path / "one" / "replay", tmp_path / "two", "--check") == 0
    assert "all 30 beliefs are those of the live filter, to the bit" in capsys.readouterr().out


def test_settings_come_from_the_recording_a_profile_and_the_command_line(tmp_path, capsys):
    source = recording(20)
    source.note["parameters"] = json.dumps(
        {"/arm/filter": {"fusion_mode": "exact", "inputs.tf_timeout": 0.1, "former_setting": 3}}
    )
    bag = source.write(tmp_path / "bag")

    def settings(*options) -> dict:
        assert replay(bag, tmp_path / "out", *options) == 0
        return json.loads(read_bag(tmp_path / "out" / "replay").note["parameters"])["/arm/filter"]

    assert settings()["fusion_mode"] == "exact"
    assert "settings that the filter does not have now: former_setting" in capsys.readouterr().out
    profile = tmp_path / "mine.yaml"
    profile.write_text("fusion_mode: fast\niterations: 2\n")
    found = settings("--filter", str(profile), "--set", "iterations=4")
    assert (found["fusion_mode"], found["iterations"]) == ("fast", 4)


def test_without_recorded_settings_those_of_the_configuration_are_taken_and_it_is_said(tmp_path, capsys):
    assert replay(recording(20).write(tmp_path / "bag"), tmp_path / "out") == 0
    assert "does not hold the filter's settings: those of config/filter.yaml" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--set", "process_noise=1"], "unknown name 'process_noise'.*valid: .*process_noise_translation"),
        (["--set", "iterations"], "'iterations': must be NAME=VALUE"),
        (["--set", "iterations=many"], "iterations = 'many': must be of type int"),
        (["--set", "gate_probability=2"], r"gate_probability = 2.0: must lie in \[0.5, 1\]"),
        (["--set", "fusion_mode=best"], "fusion_mode = 'best': must be one of paper, fast, exact"),
        (["--sweep", "iterations=1,x"], "iterations = 'x': must be of type int"),
        (["--sweep", "iterations=1,2", "--set", "iterations=3"], "iterations is given more than once"),
        (["--filter", "nameless"], "nameless"),
    ],
)
def test_unknown_settings_are_errors_with_the_valid_choices(tmp_path, capsys, options, message):
    assert replay(recording(10).write(tmp_path / "bag"), tmp_path / "out", *options) == 2
    assert re.search(message, capsys.readouterr().err)


def test_what_is_in_the_way_is_not_removed_unless_it_is_a_replay(tmp_path, capsys):
    bag = recording(10).write(tmp_path / "bag")
    assert replay(bag, tmp_path / "out") == 0 and replay(bag, tmp_path / "out") == 0
    recording(10).write(tmp_path / "precious" / "replay")
    assert replay(bag, tmp_path / "precious") == 2
    assert "was not written by a replay" in capsys.readouterr().err


def test_a_check_fails_where_beliefs_differ_from_the_recorded_ones(tmp_path, capsys):
    source = with_live(recording(20, touching=lambda k: True))
    source.note["parameters"] = json.dumps({"/arm/filter": {"fusion_mode": "paper"}})
    bag = source.write(tmp_path / "bag")
    assert replay(bag, tmp_path / "out", "--check") == 0
    assert "all 20 beliefs are those of the live filter, to the bit" in capsys.readouterr().out
    source.note["parameters"] = json.dumps({"/arm/filter": {"process_noise_rotation": 0.1}})
    assert replay(source.write(tmp_path / "other"), tmp_path / "out", "--check") == 1
    assert "19 of 20 beliefs differ from the live ones, first in" in capsys.readouterr().out


def test_pictures_and_report_compare_the_runs(tmp_path, capsys):
    bag = recording(60).write(tmp_path / "bag")
    assert (
        main(["replay", str(bag), "--out", str(tmp_path), "--sweep", "process_noise_rotation=1e-4,0.1"]) == 0
    )
    assert (tmp_path / "replay.png").stat().st_size > 20_000
    runs = json.loads((tmp_path / "report.json").read_text())["arms"]["arm"]["runs"]
    assert list(runs) == ["process_noise_rotation=0.1", "process_noise_rotation=1e-4"]
    small, large = runs["process_noise_rotation=1e-4"], runs["process_noise_rotation=0.1"]
    assert small["beliefs"] == large["beliefs"] == 55
    assert small["rms"]["gamma"] < large["rms"]["gamma"]  # the truth stands still, so noise does harm
    assert 0.5 < large["nees_per_dof"] < 2.0 and small["sigma"]["z"] < large["sigma"]["z"]


def test_a_bag_that_holds_nothing_to_replay_is_an_error(tmp_path, capsys):
    bag = recording(10).without("/arm/contact/estimate").write(tmp_path / "bag")
    with pytest.raises(ReplayError, match=r"no messages on <arm>/contact/estimate; topics with messages: /a"):
        read_inputs(bag)
    assert replay(bag, tmp_path / "out") == 2 and replay(tmp_path / "nothing", tmp_path / "out") == 2


def test_bags_of_the_helpers_are_sound():
    """The surface stands still and errors are as claimed: NIS is that of a filter with less process noise."""
    settings = FilterSettings(process_noise_translation=1e-6, process_noise_rotation=1e-5)
    nis = [belief.nis for belief in believed(bags.recording(200), settings) if belief.nis_dof]
    assert 0.8 < np.mean(nis) / 6.0 < 1.2


def test_live_beliefs_from_before_the_first_input_in_the_bag_are_told_apart(tmp_path):
    inputs, (run,) = replayed(with_live(recording(touching=lambda k: True)).write(tmp_path / "bag"))
    found = agreement(run.states[3:], inputs.arms[0].live)
    assert (found.only_live, found.before_inputs) == (0, 3)
    assert (found.common, found.after_gap) == (
        0,
        len(run.states) - 3,
    )  # one contact
