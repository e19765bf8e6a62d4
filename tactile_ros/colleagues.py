"""What a controller hears of others while it works: of its own estimator, and of the arms it works with."""

from __future__ import annotations

import functools
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from tactile_base import topics
from tactile_control.partners import Partners
from tactile_control.phases import DONE, FAILED
from tactile_msgs.msg import ControllerStatus
from tactile_records.bags.cdr import MessageReader, layout_of
from tactile_records.bags.message_definitions import type_fields
from tactile_ros.qos import DIAGNOSTICS, STATE
from tactile_ros.task_messages import IDLE

if TYPE_CHECKING:
    from tactile_ros.managed_node import ManagedNode


class EstimatorWord:
    """What the arm's estimator complains about in /diagnostics, in whose hands it is that estimates come.

    Attributes
    ----------
    text : str
        Empty where nothing is wrong.
    """

    def __init__(self, node: ManagedNode) -> None:
        self.text = ""
        namespace = node.get_namespace().rstrip("/")
        self._name = f"{namespace}/estimator"
        self._fields = type_fields(topics.DIAGNOSTICS.type)
        node.subscribe(DiagnosticArray, topics.DIAGNOSTICS.name, self._take, DIAGNOSTICS, raw=True)

    def _take(self, data: bytes) -> None:
        """Most of what arrives is of other nodes, of which nothing is read."""
        if self._name.encode() + b"\0" not in data:
            return
        layout = layout_of(self._fields, topics.DIAGNOSTICS.type, data)
        numbers = layout.unpack(data)
        for index in range(layout.lengths["status"]):
            if layout.texts[f"status.{index}.name"] == self._name:
                level = bytes([numbers[layout.place(f"status.{index}.level").start]])
                self.text = "" if level == DiagnosticStatus.OK else layout.texts[f"status.{index}.message"]


@dataclass(frozen=True)
class StatusWord:
    """What a controller's status says to its partners (`tactile_control.partners.Word`)."""

    over: bool
    at_work: bool
    trouble: str


def listen_to_partners(node: ManagedNode, partners: Partners) -> None:
    """Have partners hear what the controller of each says in its status, by the steady clock."""
    read = MessageReader(topics.CONTROLLER_STATUS.type)

    def take(arm: str, data: bytes) -> None:
        layout, numbers = read(data)
        over = layout.texts["phase"] in (IDLE, DONE, FAILED)
        at_work = bool(numbers[layout.place("at_work").start])
        partners.hear(arm, time.monotonic(), StatusWord(over, at_work, layout.texts["trouble"]))

    for arm in partners.arms:
        topic = topics.CONTROLLER_STATUS.of(arm).name
        node.subscribe(ControllerStatus, topic, functools.partial(take, arm), STATE, raw=True)
