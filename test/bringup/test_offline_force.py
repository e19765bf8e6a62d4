"""Runs without ROS at a reference force: a network that tells it, stood for by the simulated skin itself."""

import dataclasses

import numpy as np
import pytest

from tactile_bringup import offline
from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_control.task_file import load_task, task_path
from tactile_filter.force import ForceGaussian
from tactile_records.runs.log import RunLog
from tactile_records.runs.metrics import report


@pytest.fixture
def felt(monkeypatch):
    """Has each percept tell the skin's own normal force, with a tenth of a newton of noise; and keeps it."""
    make, forces = offline.perception, {}
    random = np.random.default_rng(0)

    def perception(*arguments):
        perceive, view = make(*arguments)

        def with_force(frame):
            percept = perceive(frame)
            if percept.estimate is None:
                return percept
            forces[frame.stamp_ns] = frame.truth.normal_force
            force = -frame.truth.normal_force * percept.estimate.mean[:3, 2] + 0.1 * random.standard_normal(3)
            return dataclasses.replace(percept, force=ForceGaussian(force, 0.01 * np.eye(3)))

        return with_force, view

    monkeypatch.setattr(offline, "perception", perception)
    return forces


@pytest.mark.slow
def test_a_ramp_is_followed_at_a_force_and_the_report_says_how_near(felt):
    changes = ["follower.force.normal=1.0", "follower.task.speed=0.02"]
    task = load_task(task_path("surface_following"), "ramp", changes=changes)
    record = run_arms_offline("ramp", task, OfflineOptions(fidelity="image"), log=RunLog)["arm"]
    assert record.result["succeeded"], record.result["reason"]
    stamps = np.array(sorted(felt))
    at_work = record.working(stamps) & (stamps > stamps[record.working(stamps)][0] + 2 * 10**9)
    true = np.array([felt[stamp] for stamp in stamps[at_work].tolist()])
    assert len(true) > 200 and np.sqrt(np.mean((true - 1.0) ** 2)) < 0.1
    said = report(record)["force"]
    assert said["reference_n"] == 1.0 and abs(said["normal_bias_n"]) < 0.1 and said["normal_rms_n"] < 0.2


@pytest.mark.slow
def test_a_run_whose_network_tells_no_force_says_so():
    task = load_task(task_path("surface_following"), "ramp", changes=["follower.force.normal=1.0"])
    record = run_arms_offline("ramp", task, OfflineOptions(fidelity="image"))["arm"]
    assert not record.result["succeeded"] and "no force has arrived" in record.result["reason"]
