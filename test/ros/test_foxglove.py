"""A running graph for Foxglove: topics with definitions, messages as they are, nothing the other way."""

import contextlib
import json
import re
import struct
import subprocess
import sys
import threading

import pytest
from geometry_msgs.msg import PoseStamped
from rclpy.qos import ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from tactile_ros import qos
from tactile_ros.conversions import header

pytest.importorskip("foxglove", reason="needs foxglove-sdk (extra view)")

PROTOCOL = "foxglove.sdk.v1"
SUBSCRIBE, MESSAGE_DATA = "subscribe", 1  # of the protocol (github.com/foxglove/ws-protocol, docs/spec.md)


@pytest.fixture(scope="module")
def address(shared_graph):
    command = [sys.executable, "-m", "tactile_bringup.cli", "foxglove", "--port", "0"]
    with subprocess.Popen(command, env=shared_graph.variables, stdout=subprocess.PIPE, text=True) as process:
        line = process.stdout.readline()
        yield re.search(r"ws://\S+(?=;)", line)[0]
        process.terminate()
    assert process.returncode == 0


class Client:
    """Speaks the protocol, in a thread of its own, beside the graph."""

    def __init__(self, address: str) -> None:
        self.socket = connect(address, subprotocols=[PROTOCOL])
        self.channels, self.data = {}, []
        threading.Thread(target=self._hear, daemon=True).start()

    def _hear(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            for message in self.socket:
                self._take(message)

    def _take(self, message: bytes | str) -> None:
        if isinstance(message, bytes):
            kind, _, _ = struct.unpack_from("<BIQ", message)
            self.data += [message[13:]] if kind == MESSAGE_DATA else []
            return
        content = json.loads(message)
        if content["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in content["channels"]}

    def subscribe(self, topic: str) -> None:
        wanted = [{"id": 1, "channelId": self.channels[topic]["id"]}]
        self.socket.send(json.dumps({"op": SUBSCRIBE, "subscriptions": wanted}))


def heard_as(graph, topic):
    """The quality of service with which the bridge hears a topic."""
    readers = graph.node.get_subscriptions_info_by_topic

    def of_bridge():
        return [info for info in readers(topic) if info.node_name == "tactile_foxglove"]

    assert graph.wait(lambda: bool(of_bridge()))
    return of_bridge()[0].qos_profile


def test_a_topic_comes_with_its_definition_and_messages_as_they_are(shared_graph, address):
    out = shared_graph.node.create_publisher(PoseStamped, "/arm/arm/pose", qos.STATE)
    client = Client(address)
    assert shared_graph.wait(lambda: "/arm/arm/pose" in client.channels)
    channel = client.channels["/arm/arm/pose"]
    assert channel["encoding"] == "cdr" and channel["schemaEncoding"] == "ros2msg"
    assert (
        channel["schemaName"] == "geometry_msgs/msg/PoseStamped"
        and "MSG: geometry_msgs/Pose" in channel["schema"]
    )
    client.subscribe("/arm/arm/pose")
    # no publisher keeps for it what it has missed
    assert heard_as(shared_graph, "/arm/arm/pose").reliability == ReliabilityPolicy.BEST_EFFORT
    message = PoseStamped(header=header(1_700_000_000_000_000_000, "arm/base"))
    message.pose.position.x = 0.25

    def heard() -> bool:
        out.publish(message)
        return bool(client.data)

    assert shared_graph.wait(heard)
    # gaps between numbers hold anything
    assert len(client.data[0]) == len(serialize_message(message))
    assert deserialize_message(client.data[0], PoseStamped) == message
    client.socket.close()


def test_who_comes_late_gets_what_was_said_once(shared_graph, address):
    out = shared_graph.node.create_publisher(String, "/arm/robot_description", qos.LATCHED)
    out.publish(String(data="once"))
    clients = []
    for _ in range(2):  # the second to a topic that is heard already
        client = Client(address)
        clients.append(client)
        assert shared_graph.wait(lambda client=client: "/arm/robot_description" in client.channels)
        client.subscribe("/arm/robot_description")
        assert shared_graph.wait(lambda client=client: bool(client.data))
        assert deserialize_message(client.data[0], String) == String(data="once")
    for client in clients:
        client.socket.close()


def test_nothing_can_be_sent(address):
    client = Client(address)
    with connect(address, subprotocols=[PROTOCOL]) as socket:
        info = json.loads(socket.recv())
    assert info["op"] == "serverInfo" and info["capabilities"] == []
    client.socket.close()
