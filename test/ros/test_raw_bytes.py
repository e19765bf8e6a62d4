"""Bytes that are no message, on every topic that a node listens to: it counts them and goes on."""

import struct
import time
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from messages import gaussian_message, image_message
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image
from tf2_msgs.msg import TFMessage

from tactile_filter import se3
from tactile_msgs.msg import ContactPresence, ContactState
from tactile_ros import qos
from tactile_ros.conversions import header, transform_stamped
from tactile_ros.managed_node import refused_counter

SENSOR = "arm/tactile_sensor"
FILTER, OBJECT = "tactile_ros.nodes.filter_node", "tactile_ros.nodes.object_node"
CONTROLLER, ESTIMATOR = "tactile_ros.nodes.controller_node", "tactile_ros.nodes.estimator_node"
CELL = {FILTER: {}, OBJECT: {"arms": "[arm]"}, CONTROLLER: {}, ESTIMATOR: {}}
SEED, FORGED = 20, 150  # messages a topic
EXTREMES = (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e160, 5e-324)
LISTENERS = {
    "/tf": "filter",
    "/tf_static": "filter",
    "contact/estimate": "filter",
    "contact/presence": "filter",
    "contact/belief": "object",
    "contact/state": "controller",
    "tactile/image": "estimator",
}
HEAD = 200  # bytes in which lengths and names stand


def examples() -> list:
    """A sound message for each topic, stamped now: type, name, quality of service, message."""
    stamp_ns, cov = time.time_ns(), np.diag(np.full(6, 1e-6))
    pose = se3.exp([0.0, 0.0, -3e-3, 0.0, 0.0, 0.0])
    tf = TFMessage(transforms=[transform_stamped(stamp_ns, "arm/base", "arm/tool", pose)] * 2)
    gaussian = gaussian_message(stamp_ns, SENSOR, pose, cov)
    presence = ContactPresence(header=header(stamp_ns, SENSOR), in_contact=True)
    state = ContactState(header=header(stamp_ns, SENSOR))
    image = image_message(stamp_ns, SENSOR, np.full((480, 640), 100, np.uint8))
    return [
        (TFMessage, "/tf", qos.TF, tf),
        (TFMessage, "/tf_static", qos.TF_STATIC, tf),
        (PoseWithCovarianceStamped, "contact/estimate", qos.STATE, gaussian),
        (PoseWithCovarianceStamped, "contact/belief", qos.STATE, gaussian),
        (ContactPresence, "contact/presence", qos.STATE, presence),
        (ContactState, "contact/state", qos.STATE, state),
        (Image, "tactile/image", qos.IMAGE, image),
    ]


def with_length(sound: bytes, at: int) -> bytes:
    """The message with 512 MB claimed at a place where a length may stand."""
    return sound[:at] + (0x20000000).to_bytes(4, "little") + sound[at + 4 :]


def forged(sound: bytes, random: np.random.Generator) -> bytes:
    """The message with something wrong: cut, flipped, text that is no text, numbers beyond all, noise."""
    data = bytearray(sound)
    head = min(len(data), HEAD)
    at = int(random.integers(4, head - 4))
    match int(random.integers(6)):
        case 0:
            return bytes(data[: random.integers(len(data))])
        case 1:
            data[at] ^= 1 << int(random.integers(8))
        case 2:
            data[at : at + 4] = b"\xff\xfe\x80\xc0"
        case 3:
            data[4:head] = random.bytes(head - 4)
        case 4:
            data[: len(data) // 2] = random.bytes(len(data) // 2)
        case 5:
            at -= at % 8 - 4  # where a double may stand
            data[at : at + 8] = struct.pack("<d", random.choice(EXTREMES))
    return bytes(data)


def heard_as(topic: str) -> str:
    """The name by which the node that listens counts a topic."""
    return f"/arm/{topic}" if LISTENERS[topic] == "object" and not topic.startswith("/") else topic


def memory_mb(process) -> float:
    """The most that the process has held so far."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024.0


@pytest.fixture(scope="module")
def running(shared_graph):
    return {node: shared_graph.start(node, parameters) for node, parameters in CELL.items()}


@pytest.mark.parametrize("example", examples(), ids=lambda example: example[1])
def test_no_bytes_end_a_node_nor_make_it_allocate_what_they_claim(shared_graph, running, example):
    message_type, topic, profile, _ = example
    before = {node: memory_mb(process) for node, process in running.items()}
    publisher = shared_graph.publisher(message_type, topic, profile)
    arm, random = shared_graph.arm(), np.random.default_rng(SEED)
    place = [each[1] for each in examples()].index(topic)
    sound = serialize_message(examples()[place][3])
    lengths = range(4, min(len(sound), HEAD) - 3, 4)
    for at in [*lengths, *[None] * FORGED]:
        arm.at(time.time_ns())
        sound = serialize_message(examples()[place][3])
        publisher.publish(forged(sound, random) if at is None else with_length(sound, at))
        shared_graph.spin(0.001)
    shared_graph.settle()  # all answer still
    shared_graph.wait_for_count(LISTENERS[topic], refused_counter(heard_as(topic)))
    for node, process in running.items():
        assert process.poll() is None, shared_graph.log(node).read_text()[-2000:]
        assert memory_mb(process) - before[node] < 100.0
