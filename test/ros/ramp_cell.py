"""Simulator, filter and controller on the ramp: a graph for tests, whose sensor says the noisy truth."""

import dataclasses

import numpy as np

from tactile_base.config_paths import config_path
from tactile_bringup.run_sequence import arm_plans
from tactile_control.task_file import load_task, task_path
from tactile_msgs.action import RunTask
from tactile_msgs.msg import ArmStatus, ContactTruth, ControllerStatus, StageLatency
from tactile_ros import qos
from tactile_ros.conversions import ns_from_time
from tactile_ros.task_messages import goal_message
from tactile_scene.scene_file import load_scene

SIM, FILTER = "tactile_ros.nodes.sim_node", "tactile_ros.nodes.filter_node"
CONTROLLER, RECORDER = "tactile_ros.nodes.controller_node", "tactile_ros.nodes.recorder_node"
SECOND = 1_000_000_000
CHEAPER = (
    ("bodies:", "simulation: {rate: 60, sensors: {arm: {fidelity: ideal}}}\nbodies:"),
    ("0.062]", "0.053]"),  # 3 mm above the ramp instead of 12
    ("camera_rate: 60", "camera_rate: 30"),
)
# a machine that holds up a process only delays the task
WHATEVER_THE_LOAD = {
    "watchdog.patience": 30.0,
    "watchdog.start_timeout": 30.0,
    "contact.approach_timeout": 60.0,
    "contact.settle_timeout": 60.0,
}


class Cell:
    """The running graph on the ramp, near the surface."""

    def __init__(self, graph, folder, length: float = 0.1) -> None:
        text = config_path("scenes/ramp.yaml").read_text()
        for old, new in CHEAPER:
            assert old in text
            text = text.replace(old, new)
        (folder / "ramp.yaml").write_text(text)
        task = load_task(task_path("surface_following"), "ramp")
        self.plan = arm_plans(task, load_scene(folder / "ramp.yaml"))[0]
        settings = dataclasses.asdict(self.plan.role.settings)
        parameters = {
            f"{group}.{name}": value for group, values in settings.items() for name, value in values.items()
        }
        self.graph = graph
        self.truths = graph.collect(ContactTruth, "sim/truth")
        self.statuses = graph.collect(ControllerStatus, "controller/status")
        self.arms = graph.collect(ArmStatus, "arm/status")
        self.latencies = graph.collect(StageLatency, "latency", qos.LATENCY)
        graph.start(CONTROLLER, {**parameters, **WHATEVER_THE_LOAD}, wait=False)
        graph.start(FILTER, wait=False)
        graph.start(SIM, {"scene": str(folder / "ramp.yaml"), "seed": 1}, namespace="")
        for module in (FILTER, CONTROLLER):
            graph.wait_until_active(module)
        self.client = graph.action(RunTask, "run_task")
        assert graph.wait(lambda: bool(self.statuses) and bool(self.arms))
        goal = self.plan.goals[0]
        self.goal = dataclasses.replace(goal, goal=goal.goal.replaced(length=length))

    def send(self):
        request = goal_message(self.plan.role.task, self.goal)
        future = self.client.send_goal_async(request)
        assert self.graph.wait(future.done) and future.result().accepted
        return future.result()

    def result(self, handle):
        future = handle.get_result_async()
        assert self.graph.wait(future.done), self.statuses[-1]
        return future.result().result

    def following(self):
        handle = self.send()

        def underway() -> bool:
            return self.statuses[-1].phase == "follow" and np.linalg.norm(self.arms[-1].twist[:3]) > 0.005

        assert self.graph.wait(underway), self.statuses[-1]
        return handle

    def assert_at_rest_within(self, since_ns: int, seconds: float) -> None:
        """In the arm's own time: that it moves no later, however long it takes until we hear of it."""
        until_ns = since_ns + round((seconds + 0.3) * SECOND)
        assert self.graph.wait(lambda: ns_from_time(self.arms[-1].header.stamp) > until_ns)
        moving = [ns_from_time(m.header.stamp) for m in self.arms if np.any(np.array(m.twist) != 0.0)]
        assert np.all(np.array(self.arms[-1].twist) == 0.0)
        assert (moving[-1] - since_ns) / SECOND < seconds
