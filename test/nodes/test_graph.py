"""Simulator, filter and controller together: a surface is followed; a part that falls silent stops the arm.

The sensor is an ideal one (its estimate is the noisy truth), so that these tests are about the graph.
"""

import dataclasses
import signal

import numpy as np
import pytest
from rclpy.action import ActionClient

from tactile_bringup.ros import qos
from tactile_bringup.ros.conversions import pose_from_matrix
from tactile_bringup.ros.stamps import ns_from_time
from tactile_control.files import load_task
from tactile_drivers.scene import load_scene
from tactile_filter.config_paths import config_path
from tactile_msgs.action import RunTask
from tactile_msgs.msg import ArmStatus, ContactTruth, ControllerStatus, StageLatency

SIM, FILTER = "tactile_drivers.sim_node", "tactile_filter.filter_node"
CONTROLLER = "tactile_control.controller_node"
SECOND = 1_000_000_000


class Cell:
    """The running graph on the ramp, near the surface."""

    def __init__(self, graph, folder) -> None:
        text = config_path("scenes/ramp.yaml").read_text().replace("fidelity: image", "fidelity: ideal")
        assert "0.062]" in text
        text = text.replace("0.062]", "0.053]")  # 3 mm above the ramp instead of 12
        (folder / "ramp.yaml").write_text(text)
        task = load_task(config_path("tasks/surface_following.yaml"), "ramp")
        settings = dataclasses.asdict(task.settings)
        parameters = {
            f"{group}.{name}": value for group, values in settings.items() for name, value in values.items()
        }
        self.graph = graph
        self.truths = graph.collect(ContactTruth, "sim/truth")
        self.statuses = graph.collect(ControllerStatus, "controller/status")
        self.arms = graph.collect(ArmStatus, "arm/status")
        self.latencies = graph.collect(StageLatency, "latency", qos.LATENCY)
        graph.start(CONTROLLER, parameters, wait=False)
        graph.start(FILTER, wait=False)
        graph.start(SIM, {"scene": str(folder / "ramp.yaml"), "seed": 1}, namespace="")
        for module in (FILTER, CONTROLLER):
            assert graph.wait(lambda module=module: "active" in graph.log(module).read_text(), 10.0)
        self.client = ActionClient(graph.node, RunTask, "run_task")
        assert graph.wait(self.client.server_is_ready, 5.0)
        assert graph.wait(lambda: bool(self.statuses) and bool(self.arms), 5.0)
        arm = load_scene(folder / "ramp.yaml").arms["arm"]
        self.goal = dataclasses.replace(task.goals(arm.T_base_start)[0], length=0.02)

    def send(self):
        goal = self.goal
        request = RunTask.Goal(
            task="surface_following",
            path_name=goal.name,
            direction=[float(np.cos(goal.direction)), float(np.sin(goal.direction))],
            path_length=goal.length,
            start=[pose_from_matrix(goal.start)] if goal.start is not None else [],
        )
        future = self.client.send_goal_async(request)
        assert self.graph.wait(future.done, 5.0) and future.result().accepted
        return future.result()

    def result(self, handle, timeout: float):
        future = handle.get_result_async()
        assert self.graph.wait(future.done, timeout), self.statuses[-1]
        return future.result().result

    def following(self):
        handle = self.send()
        assert self.graph.wait(lambda: self.statuses[-1].phase_name == "follow", 15.0), self.statuses[-1]
        self.graph.spin(0.7)
        assert np.linalg.norm(self.arms[-1].twist[:3]) > 0.005
        return handle

    def assert_at_rest_within(self, since_ns: int, seconds: float) -> None:
        self.graph.spin(0.6)
        moving = [ns_from_time(m.header.stamp) for m in self.arms if np.any(np.array(m.twist) != 0.0)]
        assert np.all(np.array(self.arms[-1].twist) == 0.0)
        assert (moving[-1] - since_ns) / SECOND < seconds


@pytest.fixture
def cell(graph, tmp_path):
    return Cell(graph, tmp_path)


def test_the_ramp_is_followed_at_depth_and_along_the_normal(cell):
    result = cell.result(cell.send(), 30.0)
    assert result.success, result.reason
    started = next(ns_from_time(m.header.stamp) for m in cell.statuses if m.phase_name == "follow")
    ended = max(ns_from_time(m.header.stamp) for m in cell.statuses if m.phase_name == "follow")
    path = [m for m in cell.truths if started + SECOND // 2 < ns_from_time(m.header.stamp) < ended]
    depth_mm = np.array([m.depth for m in path]) * 1e3
    angle_deg = np.degrees([m.normal_angle for m in path])
    assert all(m.in_contact for m in path)
    assert np.sqrt(np.mean((depth_mm - 3.0) ** 2)) < 0.3
    assert np.sqrt(np.mean(angle_deg**2)) < 2.0


def test_each_exposure_is_answered_or_counted_as_dropped(cell):
    cell.following()
    seen: dict[str, dict[int, int]] = {"camera": {}, "filter": {}, "controller": {}}
    for message in cell.latencies:
        for exposed, dropped in zip(message.exposed, message.dropped, strict=True):
            seen[message.stage][ns_from_time(exposed)] = dropped
    since = max(min(by_stamp) for by_stamp in seen.values())
    until = min(max(by_stamp) for by_stamp in seen.values())
    stamps = {stage: {s for s in by_stamp if since <= s <= until} for stage, by_stamp in seen.items()}
    assert len(stamps["camera"]) > 100
    assert stamps["filter"] == stamps["controller"]
    missing = stamps["camera"] - stamps["filter"]
    assert len(missing) <= seen["filter"][until] - seen["filter"][since]


def test_a_filter_that_stops_brings_the_arm_to_rest_and_the_task_ends_with_the_reason(cell):
    handle = cell.following()
    stopped_ns = cell.graph.now_ns()
    stopped = cell.graph.processes.children[FILTER].process
    stopped.send_signal(signal.SIGSTOP)
    try:
        cell.assert_at_rest_within(stopped_ns, 0.3)
        result = cell.result(handle, 5.0)
    finally:
        stopped.send_signal(signal.SIGCONT)
    assert not result.success and "belief" in result.reason and "limit" in result.reason


def test_a_filter_that_pauses_brings_the_arm_to_rest_and_the_task_goes_on(cell):
    handle = cell.following()
    paused_ns = cell.graph.now_ns()
    paused = cell.graph.processes.children[FILTER].process
    paused.send_signal(signal.SIGSTOP)
    try:
        cell.assert_at_rest_within(paused_ns, 0.3)
    finally:
        paused.send_signal(signal.SIGCONT)
    result = cell.result(handle, 15.0)
    assert result.success, result.reason


def test_a_controller_that_is_killed_leaves_the_arm_at_rest_by_the_arms_own_watchdog(cell):
    cell.following()
    killed_ns = cell.graph.now_ns()
    cell.graph.processes.children[CONTROLLER].process.kill()
    cell.assert_at_rest_within(killed_ns, 0.3)
    assert "no command for" in cell.arms[-1].reason


def test_a_controller_that_is_shut_down_brings_the_arm_to_rest_at_once(cell):
    cell.following()
    stopped_ns = cell.graph.now_ns()
    assert cell.graph.stop(CONTROLLER) == 0
    cell.assert_at_rest_within(stopped_ns, 0.25)
