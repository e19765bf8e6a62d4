"""Real nodes in processes of their own over real DDS, each test in a ROS domain of its own on this host."""

import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not in this environment: make, then . scripts/env.sh")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState, GetState  # noqa: E402
from messages import arm_command  # noqa: E402
from rcl_interfaces.srv import GetParameters, SetParameters  # noqa: E402
from rclpy.action import ActionClient  # noqa: E402
from rclpy.parameter import Parameter, parameter_value_to_python  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

from tactile_base.node_topics import LAST_ZEROS  # noqa: E402
from tactile_bringup.launching import shared_memory  # noqa: E402
from tactile_bringup.launching.environment import ros_environment  # noqa: E402
from tactile_bringup.launching.processes import ProcessGroup, tail  # noqa: E402
from tactile_msgs.msg import ArmCommand, ArmStatus  # noqa: E402
from tactile_ros import qos  # noqa: E402
from tactile_ros.conversions import transform_stamped  # noqa: E402
from tactile_ros.discovery import use_dds_profile  # noqa: E402

ARM = "arm"
BASE, TOOL, SENSOR = "arm/base", "arm/tool", "arm/tactile_sensor"
SECOND = 1_000_000_000
PATIENCE = 60.0  # s; a wait ends as soon as it can: only a test that fails waits as long, on any machine
DEPTH = 2000  # messages that wait for us while the test itself is held up


class Commands:
    """Asks an arm for twists in a frame: for rest as long as it waits for that, then for what is wanted."""

    def __init__(self, graph: "Graph", frame: str, source: str, arm: str) -> None:
        self._graph, self._frame, self._source = graph, frame, source
        self.moved = False  # whether the last one was what is wanted
        self._statuses = graph.collect(ArmStatus, f"/{arm}/arm/status")
        self._out = graph.publisher(ArmCommand, f"/{arm}/command/request", qos.COMMAND)

    def __call__(self, twist) -> None:
        self.moved = self._heard()
        wanted = twist if self.moved else np.zeros(6)
        self._out.publish(arm_command(self._graph.now_ns(), self._frame, wanted, self._source))

    def _heard(self) -> bool:
        if not self._statuses:
            return False
        status = self._statuses[-1]
        waits = status.refused_source == self._source and "twist of zero" in status.refused
        return status.owner == self._source and not waits


class Graph:
    """Nodes under test, and a node of the test's own in the same domain."""

    def __init__(self, folder: Path) -> None:
        environment = ros_environment(folder)
        self.variables = environment.variables
        self.folder = folder
        self.started_ns = time.time_ns()
        self.processes = ProcessGroup(grace_s=20.0, kill_after_s=1.0)
        use_dds_profile()
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=environment.domain_id)
        self.node = rclpy.create_node("test", context=self.context, namespace=ARM)
        from rclpy.experimental import EventsExecutor

        self.executor = EventsExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.clients: dict[str, Any] = {}
        self.actions: list[ActionClient] = []
        self.diagnostics = self.collect(DiagnosticArray, "/diagnostics", qos.DIAGNOSTICS)

    def close(self) -> None:
        """End the nodes without their goodbyes, one of which could lock this process up for good.

        So it is for a participant of Fast DDS that announces itself at that moment (docs/operating.md).
        """
        self.processes.stop(urgent=True)
        self.processes.close()
        for action in self.actions:  # one that is left keeps the whole participant alive
            action.destroy()
        self.executor.remove_node(self.node)
        self.node.destroy_node()
        self.context.shutdown()
        shared_memory.remove_orphans(self.started_ns)  # what is left would be taken over with its old state

    # ---- nodes under test ----

    def import_from(self, folders: list[str]) -> None:
        """Let nodes that are started from now on find packages in these folders, too."""
        before = self.variables.get("PYTHONPATH", "")
        self.variables["PYTHONPATH"] = os.pathsep.join(filter(None, [*folders, before]))

    def start(
        self, module: str, parameters: dict[str, Any] | None = None, wait: bool = True, namespace: str = ARM
    ):
        """Start a node; unless told otherwise wait until it is active. Returns its process."""
        return self._start(module, [sys.executable, "-m", module], parameters, wait, namespace)

    def start_code(self, name: str, code: str, parameters: dict[str, Any] | None = None, wait: bool = True):
        """Start a node whose program is given as text."""
        return self._start(name, [sys.executable, "-c", code], parameters, wait, ARM)

    def _start(
        self, name: str, command: list[str], parameters: dict[str, Any] | None, wait: bool, namespace: str
    ):
        arguments = ["--ros-args", "-r", f"__ns:=/{namespace}"]
        for key, value in {"diagnostics_period": 0.1, **(parameters or {})}.items():
            arguments += ["-p", f"{key}:={yaml_value(value)}"]
        log = self.log(name)
        child = self.processes.start(name, [*command, *arguments], self.variables, log)
        if wait:
            self.wait_until_active(name)
            self.settle()
        return child.process

    def wait_until_active(self, name: str) -> None:
        """Wait until a started node is active; fails at once if it ends instead."""
        child = self.processes.children[name]
        self.wait(lambda: "active" in child.log.read_text() or child.process.poll() is not None)
        assert "active" in child.log.read_text(), f"{name} is not active:\n{tail(child.log)}"

    def settle(self) -> None:
        """Wait until each node under test knows every topic that this process has opened so far.

        That we know the other side says nothing about what it knows. But what a process opens is announced in
        order: a node that answers a client made now has heard of all that was made before.
        """
        for name in self.nodes():
            client = self.node.create_client(GetState, f"{name}/get_state")
            self._ask(client, GetState.Request(), name)
            self.node.destroy_client(client)

    def nodes(self) -> list[str]:
        """Full names of the nodes under test, waiting for all of them to be seen."""

        def seen() -> list[str]:
            found = self.node.get_node_names_and_namespaces()
            # which have no state; commands of `tactile` come and go
            others = ("test", "operator", "tactile_view", "tactile_foxglove", LAST_ZEROS)
            return [f"{space.rstrip('/')}/{name}" for name, space in found if name not in others]

        def running() -> int:
            return sum(child.process.poll() is None for child in self.processes.children.values())

        assert self.wait(lambda: len(seen()) >= running()), f"of {running()} nodes only {seen()} are seen"
        return seen()

    def _ask(self, client: Any, request: Any, name: str) -> Any:
        """The answer to a question that may be asked twice."""
        assert self.wait(client.service_is_ready), f"{name} does not answer"
        for _ in range(round(PATIENCE)):
            future = client.call_async(request)
            if self.wait(future.done, 1.0):
                return future.result()
        raise AssertionError(f"no answer from {name}")

    def arm(self) -> "Arm":
        """An arm of the test's own, which publishes TF."""
        return Arm(self)

    def log(self, module: str) -> Path:
        return self.folder / f"{module}.log"

    def stop(self, module: str) -> int:
        """SIGINT; returns the exit code."""
        return self.processes.stop([module])[0].exit_code

    def reports(self, node: str) -> list[SimpleNamespace]:
        """The /diagnostics of a node so far: level (int), message, and values by key."""
        found = [s for array in self.diagnostics for s in array.status if s.name.endswith(f"/{node}")]
        return [
            SimpleNamespace(
                level=int.from_bytes(status.level, "little"),
                message=status.message,
                values={item.key: item.value for item in status.values},
            )
            for status in found
        ]

    def wait_for_report(
        self, node: str, condition: Callable[[SimpleNamespace], bool], timeout: float = PATIENCE
    ):
        """The first report of a node for which the condition holds."""

        def found() -> list[SimpleNamespace]:
            return [report for report in self.reports(node) if condition(report)]

        assert self.wait(lambda: bool(found()), timeout), f"reports of {node}: {self.reports(node)[-1:]}"
        return found()[0]

    def wait_for_count(self, node: str, counter: str, least: int = 1) -> SimpleNamespace:
        """The first report in which a counter has come this far."""
        return self.wait_for_report(node, lambda report: int(report.values.get(counter, "0")) >= least)

    def restart(self, node: str) -> None:
        """Deactivate and activate a node, which makes it forget its state, and the reports so far."""
        self.change(node, Transition.TRANSITION_DEACTIVATE)
        self.change(node, Transition.TRANSITION_ACTIVATE)
        self.diagnostics.clear()

    def change(self, node: str, transition: int) -> None:
        """Take a node to another state of its life."""
        request = ChangeState.Request(transition=Transition(id=transition))
        assert self.call(ChangeState, f"{node}/change_state", request).success, transition

    # ---- time ----

    def now_ns(self) -> int:
        return self.node.get_clock().now().nanoseconds

    def spin(self, seconds: float) -> None:
        self.wait(lambda: False, seconds)

    def wait(self, condition: Callable[[], bool], timeout: float = PATIENCE) -> bool:
        """Process messages until the condition holds; False if it does not within the timeout (s)."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            if condition():
                return True
            self.executor.spin_once(timeout_sec=0.005)
        return condition()

    def ticks(self, period: float) -> Iterator[None]:
        """Again and again at this period (s) as long as patience lasts; processes messages in between."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            yield
            self.spin(period)

    def every(self, period: float, seconds: float, action: Callable[[], None]) -> None:
        """Call `action` at this period for so long, processing messages in between."""
        end = time.monotonic() + seconds
        due = time.monotonic()
        while time.monotonic() < end:
            action()
            due += period
            self.wait(lambda due=due: time.monotonic() >= due, period)

    # ---- topics, services, parameters ----

    def collect(self, message_type: type, topic: str, profile: QoSProfile = qos.STATE) -> list:
        """The messages from now on; the nodes that run already know that we listen."""
        messages: list = []
        deep = QoSProfile(depth=DEPTH, reliability=profile.reliability, durability=profile.durability)
        self.node.create_subscription(message_type, topic, messages.append, deep)
        self.settle()
        return messages

    def publisher(self, message_type: type, topic: str, profile: QoSProfile = qos.STATE):
        """A publisher that has a subscriber already, which knows it as well."""
        publisher = self.node.create_publisher(message_type, topic, profile)
        assert self.wait(lambda: publisher.get_subscription_count() > 0), f"nobody listens to {topic}"
        self.settle()
        return publisher

    def commands(self, frame: str, source: str = "/test", arm: str = ARM) -> "Commands":
        """A commander of an arm, as a controller is one."""
        return Commands(self, frame, source, arm)

    def action(self, action_type: type, name: str) -> ActionClient:
        """A client of an action whose server is there."""
        client = ActionClient(self.node, action_type, name)
        self.actions.append(client)
        assert self.wait(client.server_is_ready), f"no action {name}"
        self.settle()
        return client

    def call(self, service_type: type, name: str, request: Any) -> Any:
        """The answer of a service, asked once: by us, whom the node knows, or its answer would go nowhere."""
        client = self.clients.get(name)
        if client is None:
            client = self.clients[name] = self.node.create_client(service_type, name)
            assert self.wait(client.service_is_ready), f"no service {name}"
            self.settle()
        future = client.call_async(request)
        assert self.wait(future.done), f"no answer from {name}"
        return future.result()

    def set_parameter(self, node: str, name: str, value: Any) -> Any:
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        return self.call(SetParameters, f"{node}/set_parameters", request).results[0]

    def get_parameter(self, node: str, name: str) -> Any:
        answer = self.call(GetParameters, f"{node}/get_parameters", GetParameters.Request(names=[name]))
        return parameter_value_to_python(answer.values[0])


class Arm:
    """Publishes TF like an arm: the tool at a pose, the sensor fixed to it."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.tf = graph.publisher(TFMessage, "/tf", qos.TF)
        static = graph.publisher(TFMessage, "/tf_static", qos.TF_STATIC)
        static.publish(TFMessage(transforms=[transform_stamped(0, TOOL, SENSOR, np.eye(4))]))
        self.newest_ns = 0

    def at(self, stamp_ns: int, T_base_tool: np.ndarray | None = None) -> None:
        self.newest_ns = max(self.newest_ns, stamp_ns)
        T = np.eye(4) if T_base_tool is None else T_base_tool
        self.tf.publish(TFMessage(transforms=[transform_stamped(stamp_ns, BASE, TOOL, T)]))


def yaml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(yaml_value, value)) + "]"
    return str(value)


@pytest.fixture
def graph(tmp_path):
    """For one test."""
    graph = Graph(tmp_path)
    yield graph
    graph.close()


@pytest.fixture(scope="module")
def shared_graph(tmp_path_factory):
    """For all tests of a module, which make their nodes start anew with `Graph.restart`."""
    graph = Graph(tmp_path_factory.mktemp("graph"))
    yield graph
    graph.close()
