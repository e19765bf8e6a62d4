"""A run without ROS as a recording: what it tells is what the run's own record holds."""

import numpy as np
import pytest

from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_bringup.offline_bag import OfflineBag
from tactile_bringup.run_sequence import arm_plans
from tactile_control.task_file import load_task, task_path
from tactile_records.bags.reader import read_bag
from tactile_records.runs.from_bag import read_arms
from tactile_scene.scene_file import load_scene
from tactile_view.cell_state import CellState


def recorded(folder, scene: str, task: str, seed: int = 1):
    """A run, and its recording."""
    scene, options = load_scene(scene), OfflineOptions("ideal", seed=seed, work_time=1.0)
    task = load_task(task_path(task), scene.name, goals_of=scene.goals_of)
    with OfflineBag(folder, scene, task.name, arm_plans(task, scene), seed) as bag:
        return run_arms_offline(scene, task, options, log=bag.log)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("offline") / "bag"
    return recorded(folder, "dual_pushing", "dual_pushing"), folder


def same(recorded, kept, *names: str) -> None:
    """Rows of the recording are those of the record at the same stamps."""
    _, ours, theirs = np.intersect1d(recorded.stamp_ns, kept.stamp_ns, return_indices=True)
    assert len(ours) == len(recorded) > 0
    for name in names:
        found, wanted = getattr(recorded, name)[ours], getattr(kept, name)[theirs]
        if found.dtype.kind in "fi":
            np.testing.assert_allclose(found, wanted, atol=1e-12)
        else:
            np.testing.assert_array_equal(found, wanted)


def test_it_holds_what_the_record_of_the_run_holds(run):
    kept, folder = run
    arms = read_arms(folder)
    assert arms.keys() == kept.keys()
    for name, arm in arms.items():
        record = kept[name]
        assert arm.task == record.task and arm.goals == record.goals and arm.role == record.role
        same(arm.pose, record.pose, "T_base_sensor")
        same(arm.arm_twist, record.arm_twist, "twist")
        same(arm.command, record.command, "twist", "unlimited", "error", "reference", "phase", "exposure_ns")
        assert len(arm.command) == len(record.command)
        assert [event.text for event in arm.events if event.kind == "phase"] == [
            event.text for event in record.events
        ]
        if len(record.belief):
            for stream, *names in (
                ("belief", "mean", "cov", "nis", "accepted"), ("estimate", "mean", "cov"),
                ("presence", "score", "in_contact"), ("truth", "slip_fraction", "in_contact"),
            ):  # fmt: skip
                assert len(getattr(arm, stream)) == len(getattr(record, stream))
                same(getattr(arm, stream), getattr(record, stream), *names)


def test_the_page_finds_all_that_it_shows(run):
    _, folder = run
    state, led = CellState(), False
    for message in sorted(read_bag(folder).messages, key=lambda each: each.received_ns):
        state.take(*message[:4])
        led |= any(len(arm.ahead) for arm in state.arms.values())
    assert not state.refused and set(state.arms) == {"leader", "follower"}
    for arm in state.arms.values():
        assert arm.controller.task and arm.status is not None and len(arm.path) > 1
    assert led, "where a push leads"
    assert state.bodies, "where what is pushed is"


def test_the_recording_changes_nothing_in_the_run(run):
    kept, _ = run
    scene = load_scene("dual_pushing")
    task = load_task(task_path("dual_pushing"), scene.name, goals_of=scene.goals_of)
    again = run_arms_offline(scene, task, OfflineOptions("ideal", seed=1, work_time=1.0))
    for name, record in again.items():
        np.testing.assert_array_equal(record.command.twist, kept[name].command.twist)
