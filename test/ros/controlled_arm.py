"""The controller's world in tests: an arm that follows its twists, at 60 Hz, and whoever sends it goals."""

import numpy as np
from action_msgs.msg import GoalStatus

from tactile_geometry import se3
from tactile_msgs.action import RunTask
from tactile_msgs.msg import ArmCommand, ControllerStatus
from tactile_ros import qos
from tactile_ros.conversions import ns_from_time

CONTROLLER = "tactile_ros.nodes.controller_node"
SENSOR = "arm/tactile_sensor"
SECOND = 1_000_000_000
PERIOD = 1.0 / 60.0
ARM_WATCHDOG = 0.1  # s
PATIENT = 30.0  # s; a machine that holds up a process only delays a task


class ControlledArm:
    """What a test's own `World` is made of; that says in `step` what one period brings."""

    T: np.ndarray

    def __init__(self, graph) -> None:
        self.graph = graph
        self.arm = graph.arm()
        self.twists = graph.collect(ArmCommand, "command/request", qos.COMMAND)
        self.statuses = graph.collect(ControllerStatus, "controller/status")
        self.client = graph.action(RunTask, "run_task")
        self.last_stamp = 0

    def hear_anew(self) -> None:
        """Forget what was heard."""
        self.last_stamp = 0
        self.twists.clear()
        self.statuses.clear()

    def is_heard(self) -> bool:
        return self.graph.wait(lambda: bool(self.twists) and bool(self.statuses))

    def set(self, name: str, value: float) -> None:
        assert self.graph.set_parameter("controller", name, value).successful

    def step(self) -> None:
        raise NotImplementedError

    def follow_twist(self, stamp_ns: int) -> None:
        """Go on for a period, unless the last twist is too old."""
        if stamp_ns - ns_from_time(self.twists[-1].header.stamp) < ARM_WATCHDOG * SECOND:
            self.T = self.T @ se3.exp(self.twist() * PERIOD)

    def run_until(self, condition) -> bool:
        for _ in self.graph.ticks(PERIOD):
            if condition():
                return True
            self.step()
        return condition()

    def twist(self) -> np.ndarray:
        return self.twists[-1].twist

    def phase(self) -> str:
        return self.statuses[-1].phase

    def send(self, **goal):
        """Send a goal; returns its handle."""
        future = self.client.send_goal_async(RunTask.Goal(**goal))
        assert self.run_until(future.done)
        return future.result()

    def ended(self, handle):
        """The answer with the result and the goal's last status."""
        future = handle.get_result_async()
        assert self.run_until(future.done)
        return future.result()

    def result(self, handle):
        return self.ended(handle).result

    def refusal(self, **goal) -> str:
        """Why a goal is refused, as the client of the action reads it."""
        ended = self.ended(self.send(**goal))
        assert ended.status == GoalStatus.STATUS_ABORTED and ended.result.reason.startswith("goal refused: ")
        return ended.result.reason
