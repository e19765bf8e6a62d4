"""The controller node runs a task that another package brings, by its parameter `task`."""

import os
from pathlib import Path

import pytest
from test_controller_node import CONTROLLER, FAST, World

from tactile_msgs.action import RunTask

MODULE = """
import numpy as np

from tactile_control.tasks.surface_following import SurfaceFollowing


class Hold(SurfaceFollowing):
    work = "hold"
    phases = tuple("hold" if phase == "follow" else phase for phase in SurfaceFollowing.phases)

    def reference_velocity(self, elapsed):
        return np.zeros(6)

    def finished(self, elapsed):
        return elapsed >= 0.3
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A folder with a package that is installed beside ours."""
    (tmp_path / "other_tasks.py").write_text(MODULE)
    info = tmp_path / "other_tasks-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-tasks\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[tactile_servoing.tasks]\nhold = other_tasks:Hold\n")
    return tmp_path


def test_a_task_of_another_package_runs_by_its_name(graph, package):
    path = os.pathsep.join([str(package), graph.variables.get("PYTHONPATH", "")])
    graph.variables = {**graph.variables, "PYTHONPATH": path}
    graph.start(CONTROLLER, {**FAST, "task_name": "hold"})
    world = World(graph)
    world.restart()
    assert "this controller was started for it" in world.refusal(), "surface following is another task"
    sent = world.client.send_goal_async(RunTask.Goal(task="hold", name="once"))
    assert world.run_until(sent.done)
    result = world.result(sent.result())
    assert result.success, result.reason
    phases = list(dict.fromkeys(status.phase for status in world.statuses))
    assert phases == ["idle", "approach", "settle", "hold", "retreat", "done"]
    assert {status.task for status in world.statuses} == {"hold"}


def test_a_move_of_an_arm_with_a_sensor_ends_where_it_touches_something(graph):
    graph.start(CONTROLLER, {"task_name": "move", "travel.timeout": 600.0, "watchdog.start_timeout": 60.0})
    world = World(graph)
    world.restart()
    world.in_contact = False
    handle = world.send(task="move", goal="{position: [0.0, 0.0, -0.2]}")
    assert world.run_until(lambda: abs(world.twist()[2]) > 0.01)
    world.in_contact = True
    result = world.result(handle)
    assert not result.success and result.reason == "touched something on the way"
    assert world.run_until(world.rests)


def test_a_task_that_does_not_exist_ends_the_process_and_lists_those_there_are(graph):
    process = graph.start(CONTROLLER, {"task_name": "surface_folowing"}, wait=False)
    assert graph.wait(lambda: process.poll() is not None)
    assert process.returncode == 1
    assert "did you mean 'surface_following'" in graph.log(CONTROLLER).read_text()
