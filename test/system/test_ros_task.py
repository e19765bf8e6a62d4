"""A whole task over real DDS: nodes in processes of their own, started, run and stopped by `tactile launch`.

The path on the ramp is a short one, in a copy of the configuration; everything else is as shipped.
"""

import itertools
import json
import os
import re
import shutil
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from launched import Launched

from tactile_base.config_paths import config_folder
from tactile_bringup.cli import main
from tactile_bringup.offline import OfflineOptions, run_offline
from tactile_control.task_file import load_task
from tactile_records.bags.reader import read_bag
from tactile_records.replay.inputs import read_inputs
from tactile_records.replay.run import agreement, run_filter
from tactile_records.replay.sweep import base_settings
from tactile_records.runs.from_bag import read_arms, stamp_of
from tactile_records.runs.metrics import report
from tactile_scene.scene_file import load_scene

pytest.importorskip("rclpy", reason="needs ROS 2")
pytestmark = [pytest.mark.ros, pytest.mark.slow]

PATH_LENGTH = 0.04  # m
# a machine that holds up a process only delays the task
SETTINGS = """    settings:
      watchdog: {patience: 30.0, start_timeout: 60.0}
      contact: {approach_timeout: 100.0, settle_timeout: 100.0}
"""


@pytest.fixture(scope="session")
def configuration(tmp_path_factory) -> Path:
    """The shipped configuration with a short path."""
    folder = tmp_path_factory.mktemp("configuration") / "config"
    shutil.copytree(config_folder(), folder)
    task = folder / "tasks" / "surface_following.yaml"
    text, changed = re.subn(r"(name: ramp, .*length: )[\d.]+", rf"\g<1>{PATH_LENGTH}", task.read_text())
    assert changed == 1, "the task file has one goal named ramp"
    assert text.count("    settings:\n      task:\n") == 1
    task.write_text(text.replace("    settings:\n", SETTINGS, 1))
    return folder


class Launch(Launched):
    """`tactile launch surface_following`."""

    def __init__(self, folder: Path, configuration: Path, *options: str) -> None:
        command = [sys.executable, "-m", "tactile_bringup.cli", "launch", "surface_following", "--headless"]
        super().__init__(
            folder, [*command, "--out", str(folder), *options], TACTILE_CONFIG_DIR=str(configuration)
        )

    def node(self, module: str) -> int:
        """The process of a node."""
        return next(pid for pid, words in self.running().items() if module in words and "--ros-args" in words)


@pytest.fixture
def launch(tmp_path, configuration):
    launches = []

    def start(*options: str) -> Launch:
        launches.append(Launch(tmp_path, configuration, *options))
        return launches[-1]

    yield start
    for launch in launches:
        launch.kill()


@pytest.fixture(scope="module")
def finished(tmp_path_factory, configuration):
    """One run to its end: the launch, its record and its report."""
    folder = tmp_path_factory.mktemp("finished")
    launch = Launch(folder, configuration, "--record", str(folder / "bag"))
    try:
        launch.wait_for("arm: follow")
        launch.end()
    finally:
        launch.kill()
    record = read_arms(folder / "bag")["arm"]
    return launch, record, report(record)


def test_the_task_is_done_and_nothing_is_left(finished):
    launch, record, values = finished
    assert launch.process.returncode == 0, launch.output
    done = re.search(r"\[1/1\] ramp: done \((\d+) mm", launch.output)
    assert done and 40 <= int(done[1]) <= 42, launch.output  # a machine that holds a step up lets it go on
    assert launch.leaves_nothing(), launch.left()
    assert record.result["bag_complete"] and values["succeeded"]


def test_what_foxglove_shows_of_a_run_stands_beside_its_logs(finished):
    (layout,) = finished[0].folder.glob("*/foxglove.json")
    assert "/arm/contact/state.euler[2]" in layout.read_text()


def test_a_recorded_run_has_a_report(finished, tmp_path):
    launch, _, values = finished
    assert main(["report", str(launch.folder / "bag"), "--out", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "report.json").read_text())["depth_rms_mm"] == values["depth_rms_mm"]
    assert (tmp_path / "trajectory.png").stat().st_size > 1000


def usual_speed(record) -> float:
    """Median of the speed at work, mm/s; the mean has in it what a busy machine has held up."""
    rows = record.pose.rows(record.working(record.pose.stamp_ns))
    ways = np.linalg.norm(np.diff(rows.T_base_sensor[:, :3, 3], axis=0), axis=1)
    return 1e3 * float(np.median(ways / (np.diff(rows.stamp_ns) * 1e-9)))


def test_contact_is_kept_at_depth_and_along_the_normal(finished):
    _, record, values = finished
    assert values["contact_fraction"] == 1.0
    assert values["depth_rms_mm"] <= 0.3
    assert values["normal_rms_deg"] <= 2.0
    assert values["path_length_mm"] == pytest.approx(40.0, abs=1.0)
    assert usual_speed(record) == pytest.approx(10.0, rel=0.05)
    assert 5.0 < values["speed_mm_s"] < 10.5


def test_every_frame_is_estimated_or_counted_as_lost(finished):
    _, record, _ = finished
    answered = record.latency["estimator"].stamp_ns
    start, end = answered[0], answered[-1]
    missing = round((end - start) * 1e-9 * 60.0) + 1 - len(answered)
    assert len(answered) > 300
    assert missing == record.lost["estimator"]  # none lost in silence, none counted twice
    exposed = record.truth.stamp_ns
    within = exposed[(exposed >= start) & (exposed <= end)]
    assert np.setdiff1d(within, answered).size <= missing


def test_images_of_the_sensor_of_the_training_are_usual_and_states_and_presences_say_so(finished):
    launch, record, values = finished
    assert 0.0 < values["novelty"]["mean"] < values["novelty"]["max"] < 0.7
    stamps, novelties = record.presence.stamp_ns.tolist(), record.presence.novelty.tolist()
    pairs = zip(stamps[1:], itertools.pairwise(novelties), strict=True)
    possible = dict(pairs)  # an estimate comes before the presence of its image
    states = [message for _, message in read_bag(launch.folder / "bag").decoded("/arm/contact/state")]
    fitting = [state.novelty in possible[stamp_of(state)] for state in states if stamp_of(state) in possible]
    assert len(fitting) > 300 and np.mean(fitting) > 0.9


def test_every_estimate_becomes_a_belief_and_a_command_or_is_counted(finished):
    _, record, _ = finished
    following = record.phase_at(record.estimate.stamp_ns) == "follow"
    believed, acted = set(record.belief.stamp_ns), set(record.latency["controller"].stamp_ns)
    no_belief = sum(stamp not in believed for stamp in record.estimate.stamp_ns[following])
    no_command = sum(stamp not in acted for stamp in record.estimate.stamp_ns[following])
    assert no_belief <= record.lost["filter"]
    assert no_command <= record.lost["filter"] + record.lost["controller"]


def test_latency_is_recorded_stage_by_stage(finished):
    _, record, values = finished
    stages = list(record.latency)
    assert stages == [s for s in ("camera", "estimator", "filter", "controller") if s in stages]
    assert stages[-2:] == ["filter", "controller"]
    assert all(values["latency_ms"]["stages"][stage]["p50"] > 0.0 for stage in stages)
    # Of frames that both have, since a stage may lose its slowest; and of most of them: a stage takes the
    # time of its output after it was sent, when the next one may have had it already.
    for earlier, later in itertools.pairwise(record.latency.values()):
        _, first, second = np.intersect1d(earlier.stamp_ns, later.stamp_ns, return_indices=True)
        assert len(first) > 100 and np.median(later.seconds[second] - earlier.seconds[first]) > 0.0
    assert 0.0 < values["latency_ms"]["p50"] <= values["latency_ms"]["p99"] < 1000.0


def test_the_loop_without_ros_agrees(finished, configuration):
    """Same scene, seed and settings: the sensor goes the same way over the surface, at the same depth."""
    _, record, values = finished
    scene = load_scene(configuration / "scenes" / "ramp.yaml")
    task = load_task(configuration / "tasks" / "surface_following.yaml", "ramp")
    offline = run_offline(scene, task, OfflineOptions(seed=record.seed, latency=0.006))
    others = report(offline)
    assert others["succeeded"]
    assert values["depth_rms_mm"] == pytest.approx(others["depth_rms_mm"], abs=0.1)
    assert values["normal_rms_deg"] == pytest.approx(others["normal_rms_deg"], abs=0.7)
    along = np.linspace(0.005, 0.035, 31)
    difference = _height_along_path(record, along) - _height_along_path(offline, along)
    assert np.abs(difference).max() < 0.3e-3


def _height_along_path(record, along):
    """Height of the sensor's centre (m) over the distance along y since following began."""
    following = record.phase_at(record.pose.stamp_ns) == "follow"
    position = record.pose.T_base_sensor[following][:, :3, 3]
    return np.interp(along, position[:, 1] - position[0, 1], position[:, 2])


def test_the_bag_is_opened_by_other_readers(finished):
    launch, _, _ = finished
    from rosbags.highlevel import AnyReader

    with AnyReader([launch.folder / "bag"]) as reader:
        topics = {connection.topic for connection in reader.connections}
        states = [c for c in reader.connections if c.topic == "/arm/contact/state"]
        _, _, raw = next(reader.messages(states))
        assert len(reader.deserialize(raw, states[0].msgtype).covariance) == 36
    assert {"/tf", "/tf_static", "/arm/command/request", "/diagnostics"} <= topics
    note = json.loads((read_note(launch.folder / "bag"))["parameters"])
    assert note["/arm/controller"]["task.speed"] == 0.01


def test_replayed_beliefs_are_the_live_ones_to_the_bit(finished, tmp_path):
    launch, _, _ = finished
    inputs = read_inputs(launch.folder / "bag")
    settings = base_settings(inputs, None)["arm"]
    run = run_filter(inputs.arms[0], settings)
    lost = sum(inputs.bag.lost.values())  # a recorder that is not held up for 30 s loses none
    assert inputs.arms[0].live is not None and (inputs.remarks == [] or not inputs.bag.complete)
    found = agreement(run.states, inputs.arms[0].live)
    assert found.only_live <= lost
    assert found.common > 300 and found.identical == found.common, found.first_difference


def read_note(bag: Path) -> dict[str, str]:
    return read_bag(bag).note


def test_a_truncated_bag_still_gives_the_run_up_to_there(finished, tmp_path):
    launch, record, _ = finished
    shutil.copytree(launch.folder / "bag", tmp_path / "bag")
    file = next((tmp_path / "bag").glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    part = read_arms(tmp_path / "bag")["arm"]
    assert 0 < len(part.belief) < len(record.belief)
    assert not part.result["bag_complete"] and "ends early" in part.result["bag_problem"]
    assert not part.result["succeeded"]
    assert part.result["reason"] == "goal ramp was not reached: the recording ends in its phase 'follow'"


def test_ctrl_c_in_mid_run_brings_the_arm_to_rest_and_a_recorder_that_is_held_up_still_gets_all(
    launch, tmp_path
):
    run = launch("--record", str(tmp_path / "bag"))
    run.wait_for("arm: follow")
    recorder = run.node("tactile_ros.nodes.recorder_node")
    os.kill(recorder, signal.SIGSTOP)
    stopped_ns = time.time_ns()
    time.sleep(2.0)
    run.process.send_signal(signal.SIGINT)
    run.wait_for("the recorder is held up")
    os.kill(recorder, signal.SIGCONT)
    assert run.end() == 130, run.output
    assert "stopped by SIGINT: bringing the arm to rest" in run.output
    assert "stopped: the arm rests" in run.output, run.output
    assert run.leaves_nothing(), run.left()
    record = read_arms(tmp_path / "bag")["arm"]
    gaps = read_bag(tmp_path / "bag").gaps  # publishers of an action's status keep one message only
    assert {gap.topic for gap in gaps} <= {"/arm/run_task/_action/status"}, gaps
    assert (record.belief.stamp_ns > stopped_ns).sum() > 60  # of two seconds, whatever the machine lost


def test_a_node_killed_in_mid_run_ends_the_task_with_its_name_and_log(launch, tmp_path):
    run = launch("--record", str(tmp_path / "bag"))
    run.wait_for("arm: follow")
    os.kill(run.node("tactile_ros.nodes.filter_node"), signal.SIGKILL)
    assert run.end() == 3, run.output
    assert "node /arm/filter was killed by SIGKILL" in run.output
    assert "arm.filter.log" in run.output
    # a process that is killed while it holds shared memory may keep the others from speaking for seconds
    unheard = "arm was not seen at rest: it has not reported for " in run.output
    assert unheard or "stopped: the arm rests" in run.output, run.output
    assert run.leaves_nothing(), run.left()
    record = read_arms(tmp_path / "bag")["arm"]
    assert record.result["bag_complete"] and not record.result["succeeded"]
    last = record.arm_twist.twist[-1]
    assert np.abs(last).max() < 1e-4  # the bag sees the arm come to rest


def test_a_model_that_is_missing_is_said_at_once(launch):
    run = launch("--model", "/no/such/model.onnx")
    assert run.end() == 2
    assert "--model /no/such/model.onnx: no such file" in run.output
