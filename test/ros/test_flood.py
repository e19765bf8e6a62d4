"""A stranger who sends as much as it can: nodes keep little of it, refuse it, and go on."""

import signal
import time
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.serialization import serialize_message
from tf2_msgs.msg import TFMessage

from tactile_msgs.action import RunTask
from tactile_ros import qos
from tactile_ros.conversions import header, transform_stamped
from tactile_ros.managed_node import refused_counter

FILTER, CONTROLLER = "tactile_ros.nodes.filter_node", "tactile_ros.nodes.controller_node"
RECORDER = "tactile_ros.nodes.recorder_node"
LONG = "x" * 1_000_000
COUNT = 300  # of each
GROWTH = 100.0  # MB, of what a node that keeps up has held at most


def most_mb(process) -> float:
    """The most memory that a process has held so far."""
    return int(Path(f"/proc/{process.pid}/status").read_text().split("VmHWM:")[1].split()[0]) / 1024.0


def poses() -> PoseWithCovarianceStamped:
    return PoseWithCovarianceStamped(header=header(time.time_ns(), LONG))


def reports() -> DiagnosticArray:
    status = DiagnosticStatus(name="/arm/filter", message=LONG, level=DiagnosticStatus.WARN)
    return DiagnosticArray(status=[status])


def frames() -> TFMessage:
    return TFMessage(transforms=[transform_stamped(time.time_ns(), "world", LONG, np.eye(4))])


@pytest.fixture(scope="module")
def running(shared_graph):
    listed = (
        "[/diagnostics diagnostic_msgs/msg/DiagnosticArray reliable, /tf tf2_msgs/msg/TFMessage reliable]"
    )
    recorder = {"bag": str(shared_graph.folder / "bag"), "topics": listed}
    nodes = {FILTER: {}, CONTROLLER: {}, RECORDER: recorder}
    return {node: shared_graph.start(node, parameters) for node, parameters in nodes.items()}


@pytest.mark.parametrize(
    ("make", "topic", "profile", "node"),
    [
        (poses, "contact/estimate", qos.STATE, "filter"),
        (reports, "/diagnostics", qos.DIAGNOSTICS, "controller"),
        (frames, "/tf", qos.TF, "filter"),
    ],
    ids=lambda value: str(value) if isinstance(value, str) else "",
)
def test_a_flood_of_large_messages_is_refused_and_not_kept(shared_graph, running, make, topic, profile, node):
    before = {name: most_mb(process) for name, process in running.items()}
    message = make()
    publisher = shared_graph.publisher(type(message), topic, profile)
    data = serialize_message(message)
    for _ in range(COUNT):
        publisher.publish(data)
        shared_graph.spin(0.002)
    shared_graph.wait_for_count(node, refused_counter(topic))
    shared_graph.settle()
    for name, process in running.items():
        assert process.poll() is None and most_mb(process) - before[name] < GROWTH, name


def test_a_node_that_is_held_up_keeps_no_more_than_its_depth(shared_graph, running):
    process, data = running[FILTER], serialize_message(poses())
    publisher, before = (
        shared_graph.publisher(PoseWithCovarianceStamped, "contact/estimate", qos.STATE),
        most_mb(process),
    )
    process.send_signal(signal.SIGSTOP)
    try:
        for _ in range(COUNT):
            publisher.publish(data)
            shared_graph.spin(0.002)
    finally:
        process.send_signal(signal.SIGCONT)
    shared_graph.settle()
    assert most_mb(process) - before < GROWTH + qos.STATE.depth * len(data) / 1e6


def test_goals_of_many_megabytes_are_rejected_and_forgotten(shared_graph, running):
    before, client = most_mb(running[CONTROLLER]), shared_graph.action(RunTask, "run_task")
    for _ in range(20):
        future = client.send_goal_async(RunTask.Goal(task="surface_following", name=LONG * 10))
        assert shared_graph.wait(future.done) and not future.result().accepted
    assert most_mb(running[CONTROLLER]) - before < GROWTH
