"""A person's part of the ROS graph: sees what arms do, stops and resets them, sets and asks, sends goals."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from action_msgs.srv import CancelGoal
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import ParameterDescriptor, ParameterEvent, ParameterType
from rclpy.action.client import ActionClient
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from tactile_base import topics
from tactile_base.settings import shown, unknown_name
from tactile_base.yaml_file import value_text
from tactile_bringup.launching.graph_client import GraphClient
from tactile_drivers.motion_bounds import BOUNDS
from tactile_msgs.action import RunTask
from tactile_msgs.msg import ArmStatus, ContactState, ControllerStatus
from tactile_ros.qos import DIAGNOSTICS, STATE
from tactile_scene.arm import is_at_rest

ENCLAVE = "/operator"
ANSWER = 10.0  # s, for a service to answer
RESET_ANSWER = 30.0  # s; to leave a fault of an arm takes its time
SETTLED = 1.0  # s without anything new after which all that is there counts as found
MOST_NODES = 1000  # that are told of
REPORT = 3.0  # s, for a node to report in /diagnostics
SPIN = 0.01  # s
_DESCRIBE = "/describe_parameters"


class OperatorError(RuntimeError):
    """What was asked for could not be done, in words for a person."""


@dataclass
class ArmView:
    """What an arm's nodes said last; None before they have."""

    name: str
    status: ArmStatus | None = None
    controller: ControllerStatus | None = None
    contact: ContactState | None = None
    heard_s: float = -math.inf

    @property
    def stopped(self) -> bool:
        """Whether the arm is in emergency stop and its twist is zero."""
        return (
            self.status is not None and self.status.mode == ArmStatus.ESTOP and is_at_rest(self.status.twist)
        )

    @property
    def age(self) -> float:
        """Seconds since the arm was heard of last."""
        return time.monotonic() - self.heard_s


@dataclass
class NodeView:
    """What a node reports about itself in /diagnostics."""

    level: int = 0
    message: str = ""
    values: dict[str, str] = field(default_factory=dict)


class Operator(GraphClient):
    """Looks at the arms of a ROS domain, unless `looks` is False, and acts; a context (`GraphClient`)."""

    def __init__(self, domain_id: int, looks: bool = True) -> None:
        super().__init__(ENCLAVE, domain_id)
        self._looks = looks
        self.arms: dict[str, ArmView] = {}
        self.nodes: dict[str, NodeView] = {}
        self._estop = self._node.create_publisher(Bool, topics.ESTOP.name, STATE)
        self._node.create_subscription(DiagnosticArray, topics.DIAGNOSTICS.name, self._on_report, DIAGNOSTICS)
        self._told = 0  # how many heard the last /estop
        self._actions: list[ActionClient] = []
        self._clients: dict[str, AsyncParameterClient] = {}  # by node

    def close(self) -> None:
        """See `GraphClient`."""
        for action in self._actions:
            action.destroy()
        super().close()

    # ---- looking ----

    def look(self) -> None:
        """Handle what has arrived, and listen to arms that are new."""
        self.spin(SPIN)
        for name, _ in self._node.get_topic_names_and_types() if self._looks else ():
            arm = topics.ARM_STATUS.arm_of(name)
            if arm is not None and arm not in self.arms and self._node.count_publishers(name):
                self.arms[arm] = view = ArmView(arm)
                self._listen(ArmStatus, topics.ARM_STATUS, view, "status")
                self._listen(ControllerStatus, topics.CONTROLLER_STATUS, view, "controller")
                self._listen(ContactState, topics.STATE, view, "contact")

    def find(self, timeout_s: float, enough: Callable[[], bool] | None = None) -> None:
        """Look until `enough`, or all that was found has spoken and nothing new has come for `SETTLED`."""
        end = time.monotonic() + timeout_s
        count, since = 0, time.monotonic()
        while time.monotonic() < end and not (enough is not None and enough()):
            self.look()
            known = len(self.arms) + len(self.node_names())
            if known != count:
                count, since = known, time.monotonic()
            spoke = bool(self.arms) and all(map(self._has_spoken, self.arms.values()))
            if enough is None and spoke and time.monotonic() - since > SETTLED:
                return

    def _has_spoken(self, view: ArmView) -> bool:
        controllers = self._node.count_publishers(topics.CONTROLLER_STATUS.of(view.name).name)
        return view.status is not None and (view.controller is not None or not controllers)

    def chosen(self, names: Sequence[str]) -> list[ArmView]:
        """The arms of these names, or all of them.

        Raises `OperatorError` where there is none, or none of a name.
        """
        if not self.arms:
            raise OperatorError(f"no arm was found in ROS domain {self.domain_id}")
        wanted = [name.strip("/") for name in names] or sorted(self.arms)
        for name in wanted:
            if name not in self.arms:
                raise OperatorError(f"arm: {unknown_name(name, sorted(self.arms))}")
        return [self.arms[name] for name in wanted]

    def _listen(self, message_type: type, topic: topics.Topic, view: ArmView, name: str) -> None:
        def take(message: Any) -> None:
            setattr(view, name, message)
            view.heard_s = time.monotonic()

        self._node.create_subscription(message_type, topic.of(view.name).name, take, STATE)

    def _on_report(self, message: DiagnosticArray) -> None:
        for status in message.status:
            level = status.level if isinstance(status.level, int) else status.level[0]
            values = {pair.key: pair.value for pair in status.values if pair.key in BOUNDS}
            if status.name in self.nodes or len(self.nodes) < MOST_NODES:  # strangers may invent names
                self.nodes[status.name] = NodeView(level, status.message, values)

    def limits(self, arm: str) -> dict[str, str]:
        """The limits in force, in words by the names of `BOUNDS`, once the arm's node has told them."""
        node, end = f"/{arm}/arm", time.monotonic() + REPORT
        while node not in self.nodes and time.monotonic() < end:
            self.look()
        told = self.nodes.get(node, NodeView()).values
        return {name: told[name] for name in BOUNDS if name in told} or {"limits": f"{node} does not tell"}

    def troubles(self) -> list[str]:
        """What nodes complain about, each with its node."""
        ok = DiagnosticStatus.OK[0] if isinstance(DiagnosticStatus.OK, bytes) else DiagnosticStatus.OK
        return [f"{name}: {node.message}" for name, node in sorted(self.nodes.items()) if node.level != ok]

    # ---- acting ----

    def stop(self) -> None:
        """Publish /estop, which reaches those that are known by now."""
        self._told = self._estop.get_subscription_count()
        self._estop.publish(Bool(data=True))

    def stop_new(self) -> None:
        """Publish /estop if somebody hears it by now who did not before: others may have been reset since."""
        if self._estop.get_subscription_count() > self._told:
            self.stop()

    def reset(self, arm: str) -> str:
        """Let an arm move again; returns what it answers, raises `OperatorError` with why it does not."""
        return self._trigger(f"/{arm}/arm/reset", RESET_ANSWER)

    def capture_reference(self, arm: str) -> str:
        """Have an arm's estimator take a new image without contact; as `reset`."""
        return self._trigger(f"/{arm}/estimator/capture_reference", ANSWER)

    def _trigger(self, service: str, timeout_s: float) -> str:
        answer = self._ask(Trigger, service, Trigger.Request(), timeout_s)
        if not answer.success:
            raise OperatorError(str(answer.message))
        return str(answer.message)

    def cancel(self, arm: str) -> int:
        """End the goal of an arm's controller; returns how many there were."""
        service = f"/{arm}/{topics.RUN_TASK}/_action/cancel_goal"
        answer = self._ask(CancelGoal, service, CancelGoal.Request())  # of no goal and no time: all
        return len(answer.goals_canceling)

    def run_goal(
        self, arm: str, words: dict[str, str], hear: Callable[[Any], None], ends: Callable[[], bool]
    ) -> Any:
        """Send a goal, the `words` of RunTask, and wait for its result; where it `ends` early, cancel it."""
        goal = RunTask.Goal(**words)
        client: Any = ActionClient(self._node, RunTask, f"/{arm}/{topics.RUN_TASK}")
        self._actions.append(client)
        self._wait(client.server_is_ready, f"/{arm} has no action {topics.RUN_TASK}")
        handle = self._result(client.send_goal_async(goal, lambda message: hear(message.feedback)))
        if not handle.accepted:
            raise OperatorError("the goal was rejected")
        result, cancelled = handle.get_result_async(), False
        while not result.done():
            self.look()
            if ends() and not cancelled:
                handle.cancel_goal_async()
                cancelled = True
        return result.result().result

    # ---- parameters ----

    def parameters(self, node: str) -> dict[str, tuple[Any, ParameterDescriptor]]:
        """All parameters of a node, with their descriptors."""
        client = self._parameter_client(node)
        return self._described(client, sorted(self._result(client.list_parameters()).result.names))

    def _described(
        self, client: AsyncParameterClient, names: list[str]
    ) -> dict[str, tuple[Any, ParameterDescriptor]]:
        values = self._result(client.get_parameters(names)).values
        described = self._result(client.describe_parameters(names)).descriptors
        pairs = zip(map(parameter_value_to_python, values), described, strict=True)
        return dict(zip(names, pairs, strict=True))

    def set_parameter(self, node: str, name: str, value: Any) -> tuple[Any, Any]:
        """Set one parameter; returns its values before and after; raises as `set_parameters`."""
        return self.set_parameters(node, {name: value})[name]

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
        """Set parameters of a node, all or, where one is refused, none.

        Returns the values of each before and after. Raises `OperatorError` with what was refused and why.
        """
        client, names = self._parameter_client(node), list(values)
        known = self._result(client.list_parameters()).result.names
        for name in names:
            if name not in known:
                raise OperatorError(f"{node}: {unknown_name(name, sorted(known))}")
        before = self._described(client, names)
        given = [_parameter(name, value, before[name][1]) for name, value in values.items()]
        answer = self._result(client.set_parameters_atomically(given)).result
        if not answer.successful:
            told = ", ".join(f"{name} = {value_text(value)}" for name, value in values.items())
            raise OperatorError(f"{node} refuses {told}: {answer.reason}")
        after = map(parameter_value_to_python, self._result(client.get_parameters(names)).values)
        return {name: (before[name][0], value) for name, value in zip(names, after, strict=True)}

    def hear_parameters(self, hear: Callable[[str, str, Any], None]) -> None:
        """Tell `hear` node, name and value of each parameter that has changed, from now on."""

        def take(message: ParameterEvent) -> None:
            for changed in message.changed_parameters:
                hear(message.node, changed.name, parameter_value_to_python(changed.value))

        topic = topics.PARAMETER_EVENTS.name
        self._node.create_subscription(ParameterEvent, topic, take, DIAGNOSTICS)

    def nodes_with_parameters(self) -> set[str]:
        """Full names of the nodes that answer for their parameters, as far as they are known by now."""
        services = [name for name, _ in self._node.get_service_names_and_types()]
        found = {name.removesuffix(_DESCRIBE) for name in services if name.endswith(_DESCRIBE)}
        # a service is also known of by its clients, as ours, when its node has gone
        return (found & self.node_names()) - {f"/{self._node.get_name()}"}

    def _parameter_client(self, node: str) -> AsyncParameterClient:
        client = self._clients.get(node) or AsyncParameterClient(self._node, node)
        self._clients[node] = client
        try:
            self._wait(client.services_are_ready, "it does not answer")
        except OperatorError as error:  # by now, all that are there are known
            others = sorted(self.node_names() - {ENCLAVE})
            raise OperatorError(
                f"node {unknown_name(node, others)}" if node not in others else f"{node}: {error}"
            ) from error
        return client

    # ---- waiting ----

    def _ask(self, service_type: type, name: str, request: Any, timeout_s: float = ANSWER) -> Any:
        client: Any = self._node.create_client(service_type, name)
        self._wait(client.service_is_ready, f"no service {name}")
        return self._result(client.call_async(request), timeout_s)

    def _result(self, future: Any, timeout_s: float = ANSWER) -> Any:
        self._wait(future.done, f"no answer within {timeout_s:g} s", timeout_s)
        return future.result()

    def _wait(self, holds: Callable[[], bool], otherwise: str, timeout_s: float = ANSWER) -> None:
        end = time.monotonic() + timeout_s
        while not holds():
            if time.monotonic() > end:
                raise OperatorError(otherwise)
            self.look()


def _parameter(name: str, value: Any, descriptor: ParameterDescriptor) -> Parameter[Any]:
    """A parameter; `OperatorError` for a value of which ROS has no type."""
    try:
        parameter = Parameter(name, value=_as_type(value, descriptor))
        parameter.to_parameter_msg()  # checks that a number has no more than 64 bits
    except (TypeError, ValueError, AssertionError, OverflowError) as error:
        right = "must be a number of up to 64 bits, a text, true or false, or a list of one of these kinds"
        raise OperatorError(f"{name} = {shown(value)}: {right}") from error
    return parameter


def _as_type(value: Any, descriptor: ParameterDescriptor) -> Any:
    """Whole numbers as floating-point ones where the parameter holds these: people write 3 for 3.0."""
    if descriptor.type == ParameterType.PARAMETER_DOUBLE and isinstance(value, int):
        return float(value) if not isinstance(value, bool) else value
    if descriptor.type == ParameterType.PARAMETER_DOUBLE_ARRAY and isinstance(value, list):
        return [float(item) if type(item) is int else item for item in value]
    return value
