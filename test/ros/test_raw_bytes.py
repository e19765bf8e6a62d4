"""Bytes that are no message, on every topic that a node listens to: it counts them and goes on."""

import struct
import time
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from messages import arm_command, gaussian_message, image_message
from other_package import installed
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image
from std_msgs.msg import Bool
from tf2_msgs.msg import TFMessage

from tactile_geometry import se3
from tactile_msgs.msg import ArmCommand, ArmStatus, ContactPresence, ContactState
from tactile_ros import qos
from tactile_ros.conversions import header, transform_stamped
from tactile_ros.managed_node import refused_counter

SENSOR = "arm/tactile_sensor"
FILTER, OBJECT = "tactile_ros.nodes.filter_node", "tactile_ros.nodes.object_node"
CONTROLLER, ESTIMATOR = "tactile_ros.nodes.controller_node", "tactile_ros.nodes.estimator_node"
VIEW = "tactile_ros.nodes.marker_view_node"
ARM = "tactile_ros.nodes.arm_node"
CELL = {FILTER: {}, OBJECT: {"arms": "[arm]"}, CONTROLLER: {}, ESTIMATOR: {}, VIEW: {}}
SEED, FORGED = 20, 150  # messages a topic
EXTREMES = (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e160, 5e-324)
#: Who counts what is refused on a topic; nobody where the middleware itself drops what is no message.
LISTENERS: dict[str, tuple[str, ...]] = {
    "/tf": ("filter", "controller"),
    "/tf_static": ("filter", "controller"),
    "contact/estimate": ("filter",),
    "contact/presence": ("filter",),
    "contact/belief": ("object",),
    "contact/state": ("object", "controller"),
    "tactile/image": ("estimator", "marker_view"),
    "arm/status": (),
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
    status = ArmStatus(header=header(stamp_ns, "arm/base"), mode=ArmStatus.RESTING, reason="at rest")
    image = image_message(stamp_ns, SENSOR, np.full((480, 640), 100, np.uint8))
    return [
        (TFMessage, "/tf", qos.TF, tf),
        (TFMessage, "/tf_static", qos.TF_STATIC, tf),
        (PoseWithCovarianceStamped, "contact/estimate", qos.STATE, gaussian),
        (PoseWithCovarianceStamped, "contact/belief", qos.STATE, gaussian),
        (ContactPresence, "contact/presence", qos.STATE, presence),
        (ContactState, "contact/state", qos.STATE, state),
        (Image, "tactile/image", qos.IMAGE, image),
        (ArmStatus, "arm/status", qos.STATE, status),
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


def throw(graph, publisher, make, meanwhile=lambda: None) -> None:
    """Publish the sound messages that `make` gives with every length forged in turn, then at random."""
    random, sound = np.random.default_rng(SEED), serialize_message(make())
    for at in [*range(4, min(len(sound), HEAD) - 3, 4), *[None] * FORGED]:
        meanwhile()
        sound = serialize_message(make())
        publisher.publish(forged(sound, random) if at is None else with_length(sound, at))
        graph.spin(0.001)
    graph.settle()  # all answer still


def heard_as(node: str, topic: str) -> str:
    """The name by which a node that listens counts a topic."""
    return f"/arm/{topic}" if node == "object" and not topic.startswith("/") else topic


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
    publisher, arm = shared_graph.publisher(message_type, topic, profile), shared_graph.arm()
    place = [each[1] for each in examples()].index(topic)
    throw(shared_graph, publisher, lambda: examples()[place][3], lambda: arm.at(time.time_ns()))
    for node in LISTENERS[topic]:
        shared_graph.wait_for_count(node, refused_counter(heard_as(node, topic)))
    for node, process in running.items():
        assert process.poll() is None, shared_graph.log(node).read_text()[-2000:]
        assert memory_mb(process) - before[node] < 100.0


def test_no_bytes_end_the_node_of_an_arm_and_a_stop_is_still_followed(graph, tmp_path):
    graph.import_from(installed(tmp_path))
    scene = tmp_path / "bench.yaml"
    scene.write_text(
        "arms:\n  arm:\n    driver: bench_arm\n    sensor: {camera: bench_camera}\n"
        "    start: {position: [0.1, 0.2, 0.3], rotation_deg: [0, 180, 0]}\n"
    )
    process = graph.start(ARM, {"scene": str(scene)})
    poses, statuses = graph.collect(PoseStamped, "arm/pose"), graph.collect(ArmStatus, "arm/status")

    def contact_state() -> ContactState:
        return ContactState(header=header(time.time_ns(), SENSOR))

    before = memory_mb(process)
    commands = graph.publisher(ArmCommand, "command/request", qos.COMMAND)
    throw(graph, commands, lambda: arm_command(time.time_ns(), SENSOR, np.zeros(6)))
    throw(graph, graph.publisher(ContactState, "contact/state", qos.STATE), contact_state)
    estop, random = graph.publisher(Bool, "/estop", qos.STATE), np.random.default_rng(SEED)
    longest = len(serialize_message(Bool()))
    for number in range(FORGED):  # a Bool is too short to forge a part of it
        estop.publish(random.bytes(1 + number % longest))
        graph.spin(0.001)
    graph.settle()
    for topic in ("command/request", "contact/state"):
        graph.wait_for_count("arm", refused_counter(topic))
    assert process.poll() is None and memory_mb(process) - before < 100.0
    estop.publish(Bool(data=True))
    assert graph.wait(lambda: statuses and statuses[-1].mode == ArmStatus.ESTOP)
    here, seen = poses[-1].pose, len(poses)
    assert graph.wait(lambda: len(poses) > seen + 10)
    assert poses[-1].pose == here
