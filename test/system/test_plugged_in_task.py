"""A task that another package brings through an entry point runs as one of ours, without ROS."""

import sys
from pathlib import Path

import numpy as np
import pytest

from tactile_bringup.graph import load_graph
from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_control.task_file import load_task
from tactile_control.tasks import TASKS
from tactile_scene.scene_file import load_scene

MODULE = '''
from dataclasses import dataclass, field

import numpy as np

from tactile_base.settings import Settings, setting
from tactile_control.contact_phases import APPROACH, SETTLE
from tactile_control.contact_task import ContactTask, ContactTaskSettings
from tactile_control.phases import DONE, FAILED, GO_TO_START, RETREAT, STOPPING, Goal


@dataclass(frozen=True)
class HoldSettings(Settings):
    sideways: float = setting(0.0, lower=-0.1, upper=0.1, unit="m/s", doc="speed along x meanwhile")


@dataclass(frozen=True)
class HoldTaskSettings(ContactTaskSettings):
    task: HoldSettings = field(default_factory=HoldSettings)


@dataclass(frozen=True)
class HoldGoal(Goal):
    seconds: float = setting(1.0, lower=0.0, upper=60.0, unit="s", doc="how long")


class Hold(ContactTask):
    """Holds a contact for a while."""

    settings_class = HoldTaskSettings
    goal_class = HoldGoal
    work = "hold"
    phases = (GO_TO_START, APPROACH, SETTLE, "hold", STOPPING, RETREAT, DONE, FAILED)

    def reference_velocity(self, elapsed):
        return np.array([self.settings.task.sideways, 0.0, 0.0, 0.0, 0.0, 0.0])

    def finished(self, elapsed):
        return elapsed >= self.goal.seconds
'''
TASK = """\
roles:
  holder:
    task: hold
    controller: surface_following
    settings: {task: {sideways: 0.002}}
scenes:
  plane:
    holder:
      goals: [{name: once, seconds: 1.5}]
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a package that is installed beside ours, and its task file."""
    (tmp_path / "other_tasks.py").write_text(MODULE)
    info = tmp_path / "other_tasks-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-tasks\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[tactile_servoing.tasks]\nhold = other_tasks:Hold\n")
    (tmp_path / "hold.yaml").write_text(TASK)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "other_tasks", raising=False)
    return tmp_path


def test_it_is_among_the_tasks(package):
    assert "hold" in TASKS.names() and TASKS.load("hold").work == "hold"


def test_its_task_file_runs_without_ros(package):
    task = load_task(package / "hold.yaml", "plane")
    record = run_arms_offline(load_scene("plane"), task, OfflineOptions(fidelity="ideal", seed=1))["arm"]
    assert record.result["succeeded"], record.result["reason"]
    assert (record.task, record.task_file, record.role, record.goals) == ("hold", "hold", "holder", ["once"])
    held = record.truth.rows(record.working(record.truth.stamp_ns))
    assert held.in_contact.all() and len(held) * (1 / 60.0) == pytest.approx(1.5, abs=0.1)
    assert np.sqrt(np.mean((held.T_fs[:, 2, 3] - 0.003) ** 2)) < 0.3e-3
    way = np.diff(record.pose.T_base_sensor[record.working(record.pose.stamp_ns)][[0, -1], 0, 3])
    assert abs(way[0]) == pytest.approx(1.5 * 0.002, rel=0.1)


def test_its_graph_has_a_controller_for_it(package):
    given = load_graph(str(package / "hold.yaml")).node("/arm/controller").parameters
    assert (given["task_name"], given["task.sideways"]) == ("hold", 0.002)
