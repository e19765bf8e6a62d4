"""The launcher's part of the ROS graph: waits for nodes, sends goals of RunTask, hears what the arms do."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

from action_msgs.srv import CancelGoal
from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import GetState
from rcl_interfaces.msg import Log
from rclpy.action.client import ActionClient
from rclpy.node import Node
from std_msgs.msg import Bool

from tactile_base import topics
from tactile_base.node_topics import CLIENT, LAUNCH_LOG
from tactile_bringup.launching.graph_client import GraphClient
from tactile_control.task_file import NamedGoal
from tactile_msgs.action import RunTask
from tactile_msgs.msg import ArmStatus, StageLatency
from tactile_ros.qos import LATENCY, NOTES, STATE
from tactile_ros.task_messages import goal_message
from tactile_scene.arm import is_at_rest

CONTROLLER_STAGE = "controller"
MODES = {
    ArmStatus.RESTING: "it rests",
    ArmStatus.MOVING: "it moves",
    ArmStatus.STOPPING: "it is stopping",
    ArmStatus.FAULT: "it is in fault",
    ArmStatus.ESTOP: "it is in emergency stop",
}
ASK_PERIOD = 0.2  # s between questions to a node that is not active yet
ANSWER_TIME = 1.0  # s; an answer can be lost while two nodes are still finding each other: then ask again
GAP = 0.1  # s between two words of an arm that runs regularly
SILENCE = 0.5  # s after which the last word of an arm says nothing about now


@dataclass
class Progress:
    """What is known of one arm's task at this moment.

    Attributes
    ----------
    fraction, travelled : part of the goal done, 0 to 1, and the way so far (m)
    depth, normal_error : as believed (m, rad); NaN without a belief
    latency : from exposure to command, of the last command (s); NaN before the first
    arm_mode : a constant of ArmStatus; None before its first message
    """

    phase: str = ""
    reason: str = ""
    fraction: float = 0.0
    travelled: float = 0.0
    depth: float = math.nan
    normal_error: float = math.nan
    latency: float = math.nan
    arm_mode: int | None = None
    arm_reason: str = ""


@dataclass(frozen=True)
class GoalResult:
    """How one goal ended."""

    name: str
    success: bool
    reason: str
    length: float
    duration_s: float


@dataclass
class _NodeState:
    """Whether a managed node is active, asked until it is."""

    client: Any
    question: Any = None
    asked_s: float = -math.inf
    label: str = "not there yet"
    active: bool = False


@dataclass
class _Goal:
    """A goal on its way through the action protocol."""

    name: str
    sent: Any = None
    handle: Any = None
    result: Any = None


class TaskClient(GraphClient):
    """Talks to the nodes from the launcher's own process; nothing happens unless `spin` is called.

    Parameters
    ----------
    domain_id : ROS domain of the nodes
    """

    def __init__(self, domain_id: int) -> None:
        super().__init__(CLIENT, domain_id)
        self._estop = self._node.create_publisher(Bool, topics.ESTOP.name, STATE)
        self._log = self._node.create_publisher(Log, topics.ROSOUT.name, NOTES)
        self._states: dict[str, _NodeState] = {}
        self._arms: dict[str, ArmTask] = {}

    def note(self, reason: str) -> None:
        """Have recordings know why a run ends that its nodes cannot know it of."""
        stamp = self._node.get_clock().now().to_msg()
        self._log.publish(Log(stamp=stamp, level=Log.ERROR, name=LAUNCH_LOG, msg=reason))

    def stop_arms(self) -> None:
        """An emergency stop of all arms."""
        self._estop.publish(Bool(data=True))

    def close(self) -> None:
        """See `GraphClient`."""
        for arm in self._arms.values():
            arm.close()
        super().close()

    def arm(self, name: str) -> ArmTask:
        """The task of that arm."""
        if name not in self._arms:
            self._arms[name] = ArmTask(self._node, name)
        return self._arms[name]

    def inactive(self, full_names: list[str], now_s: float) -> dict[str, str]:
        """The nodes that are not active, with the state of each; asks them again every `ASK_PERIOD`."""
        for name in full_names:
            self._ask(name, now_s)
        return {name: self._states[name].label for name in full_names if not self._states[name].active}

    def ask_again(self, name: str) -> bool:
        """Forget that a node is active, so that `inactive` asks it anew; False if it has not been."""
        state = self._states.get(name, _NodeState(None))
        was_active, state.active = state.active, False
        return was_active

    def _ask(self, name: str, now_s: float) -> None:
        if name not in self._states:
            self._states[name] = _NodeState(self._node.create_client(GetState, f"{name}/get_state"))
        state = self._states[name]
        if state.question is not None and state.question.done():
            answer = state.question.result().current_state
            state.label, state.active = answer.label, answer.id == State.PRIMARY_STATE_ACTIVE
            state.question = None
        if state.question is not None and now_s - state.asked_s > ANSWER_TIME:
            state.client.remove_pending_request(state.question)
            state.question = None
        waits = state.question is not None or state.active or now_s - state.asked_s < ASK_PERIOD
        if not waits and state.client.service_is_ready():
            state.question, state.asked_s = state.client.call_async(GetState.Request()), now_s


class ArmTask:
    """Runs goals on one arm, one at a time, and keeps its `progress`."""

    def __init__(self, node: Node, arm: str) -> None:
        self.arm = arm
        self.progress = Progress()
        self._client: Any = ActionClient(node, RunTask, f"/{arm}/{topics.RUN_TASK}")
        self._canceller: Any = node.create_client(CancelGoal, f"/{arm}/{topics.RUN_TASK}/_action/cancel_goal")
        self._goal: _Goal | None = None
        self._heard_s = self._moved_s = -math.inf
        self._regular_s = math.inf
        node.create_subscription(ArmStatus, topics.ARM_STATUS.of(arm).name, self._on_arm, STATE)
        node.create_subscription(StageLatency, topics.LATENCY.of(arm).name, self._on_latency, LATENCY)

    def close(self) -> None:
        """Let go of the action, which would otherwise keep the whole node alive."""
        self._client.destroy()

    @property
    def ready(self) -> bool:
        """Whether the action server is there."""
        return bool(self._client.server_is_ready())

    @property
    def running(self) -> bool:
        """Whether a goal is under way."""
        return self._goal is not None

    def rests_for(self) -> float:
        """Seconds for which the arm has said, and still says, that it rests; 0 otherwise.

        An arm that was stopped by safety rests where its twist is zero.
        """
        return 0.0 if self.silent else self._heard_s - self._moved_s

    def last_word(self) -> str:
        """What the arm said last, for a person."""
        if self.silent:
            return f"it has not reported for {self.silence_duration:.1f} s"
        mode = MODES.get(self.progress.arm_mode, f"mode {self.progress.arm_mode}")
        return f"{mode}: {self.progress.arm_reason}" if self.progress.arm_reason else mode

    @property
    def regular_for(self) -> float:
        """Seconds for which the arm has reported without a gap longer than `GAP`."""
        return max(0.0, self._heard_s - self._regular_s)

    @property
    def silence_duration(self) -> float:
        """Seconds since the last word of the arm."""
        return time.monotonic() - self._heard_s

    @property
    def silent(self) -> bool:
        """Whether nothing has been heard of the arm for `SILENCE`."""
        return self.silence_duration > SILENCE

    def send(self, goal: NamedGoal, task: str) -> None:
        """Send one goal."""
        self.progress = Progress(arm_mode=self.progress.arm_mode, arm_reason=self.progress.arm_reason)
        self._goal = _Goal(goal.name)
        self._goal.sent = self._client.send_goal_async(goal_message(task, goal), self._on_feedback)

    def cancel(self) -> None:
        """Ask the controller to end the goal under way, whoever sent it: it stops, and leaves the surface."""
        self._canceller.call_async(CancelGoal.Request())  # of no goal and no time: all

    def result(self) -> GoalResult | None:
        """The result of the goal under way, once; None until there is one."""
        goal = self._goal
        if goal is None:
            return None
        if goal.handle is None and goal.sent is not None and goal.sent.done():
            goal.handle = goal.sent.result()
            if not goal.handle.accepted:
                self._goal = None
                return GoalResult(goal.name, False, "the goal was rejected", 0.0, 0.0)
            goal.result = goal.handle.get_result_async()
        if goal.result is None or not goal.result.done():
            return None
        self._goal = None
        answer = goal.result.result().result
        seconds = answer.duration.sec + 1e-9 * answer.duration.nanosec
        return GoalResult(goal.name, answer.success, answer.reason, answer.path_length, seconds)

    def _on_feedback(self, message: Any) -> None:
        feedback, progress = message.feedback, self.progress
        progress.phase, progress.reason = feedback.phase, feedback.reason
        progress.fraction, progress.travelled = feedback.progress, feedback.path_length
        progress.depth, progress.normal_error = feedback.depth, feedback.normal_error

    def _on_arm(self, status: ArmStatus) -> None:
        now = time.monotonic()
        if now - self._heard_s > GAP:
            self._regular_s = now
        self._heard_s = now
        if not _rests(status):
            self._moved_s = self._heard_s
        self.progress.arm_mode, self.progress.arm_reason = status.mode, status.reason

    def _on_latency(self, message: StageLatency) -> None:
        if message.stage == CONTROLLER_STAGE:
            exposure, emitted = message.exposed[-1], message.emitted[-1]
            self.progress.latency = emitted.sec - exposure.sec + 1e-9 * (emitted.nanosec - exposure.nanosec)


def _rests(status: ArmStatus) -> bool:
    """Whether an arm says that it is at rest: by its mode, or in one that says nothing of it by its twist."""
    if status.mode in (ArmStatus.FAULT, ArmStatus.ESTOP):
        return is_at_rest(status.twist)
    return bool(status.mode == ArmStatus.RESTING)
