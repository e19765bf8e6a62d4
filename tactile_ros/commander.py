"""Whether somebody still moves an arm: a node that the arm needs goes on for as long."""

from __future__ import annotations

import time

from rclpy.node import Node

from tactile_msgs.msg import ArmCommand
from tactile_ros.qos import COMMAND

STILL = 1.0  # s without a twist other than zero after which nobody moves an arm any more
TWIST_BYTES = 48  # six numbers, the last of the message


class Commander:
    """Whoever moves an arm by twists on a topic, from now on."""

    def __init__(self, node: Node, topic: str) -> None:
        self._node, self._topic = node, topic
        self._moved = time.monotonic()
        node.create_subscription(ArmCommand, topic, self._hear, COMMAND, raw=True)

    @property
    def moves(self) -> bool:
        """Whether there is one that does; a killed one stays in the ROS graph, an idle one sends zeros."""
        return time.monotonic() - self._moved < STILL and self._node.count_publishers(self._topic) > 0

    def _hear(self, data: bytes) -> None:
        if any(data[-TWIST_BYTES:]):
            self._moved = time.monotonic()
