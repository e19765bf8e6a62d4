"""How a process of nodes ends after SIGINT or SIGTERM: in the order in which an arm comes to rest.

A launcher or a terminal may signal all nodes at once. So the order comes from the nodes: one that moves an
arm has its task stop and leave the surface first; all others go on until nobody moves their arms any more.
A second signal ends at once, and so does the end of a node's `patience`.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from tactile_msgs.msg import ArmCommand
from tactile_ros.qos import COMMAND

if TYPE_CHECKING:
    from tactile_ros.managed_node import ManagedNode

STILL = 1.0  # s without a twist other than zero after which nobody moves an arm any more
TWIST_BYTES = 48  # six numbers, the last of the message


class Ending:
    """From the first signal to the end of the process that runs `nodes`; `signals` goes on being filled."""

    def __init__(self, nodes: Sequence[ManagedNode], signals: Sequence[int]) -> None:
        self._nodes, self._signals = nodes, signals
        self._deadline = time.monotonic() + max(node.patience for node in nodes)
        reason = f"asked to end by {signal.Signals(signals[0]).name}"
        for node in nodes:
            node.prepare_to_end(reason)

    def over(self) -> bool:
        """Whether the process ends now; says so where it is not in order."""
        needed = next((node for node in self._nodes if node.needed()), None)
        if needed is None:
            return True
        hurry = len(self._signals) > 1
        late = time.monotonic() > self._deadline
        if hurry or late:
            why = "a second signal" if hurry else f"{needed.patience:g} s have passed"
            needed.get_logger().warning(f"{why}: ending before what the node works for has ended")
        return hurry or late


class Commander:
    """Whoever moves an arm by twists on a topic, from now on."""

    def __init__(self, node: ManagedNode, topic: str) -> None:
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
