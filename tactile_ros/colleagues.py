"""What a controller hears of others while it works: of its own estimator, and of the arms it works with."""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from tactile_base import topics
from tactile_control.phases import DONE, trouble_in
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


class Partners:
    """Whether the arms that a task works together with are at work, by their controllers' status.

    Parameters
    ----------
    arms : sequence of str
        Their names; their controllers publish below `/NAME`.
    age_limit : float
        Silence of a controller that counts as trouble, s.
    """

    def __init__(self, node: ManagedNode, arms: Sequence[str], age_limit: float) -> None:
        self._limit = age_limit
        self._words: dict[str, tuple[float, str]] = {}
        self._read = MessageReader(topics.CONTROLLER_STATUS.type)
        for arm in arms:
            self._words[arm] = -float("inf"), ""
            topic = topics.CONTROLLER_STATUS.of(arm).name
            node.subscribe(ControllerStatus, topic, functools.partial(self._take, arm), STATE, raw=True)

    def _take(self, arm: str, data: bytes) -> None:
        layout, numbers = self._read(data)
        phase, reason = layout.texts["phase"], layout.texts["reason"]
        waiting = bool(numbers[layout.place("waiting").start])
        word = trouble_in(DONE if phase == IDLE else phase, reason, waiting)
        self._words[arm] = time.monotonic(), word

    def trouble(self) -> str:
        """Who of them is not at work, and why; empty where all are."""
        now = time.monotonic()
        words = {
            arm: word if now - heard <= self._limit else f"no {topics.CONTROLLER_STATUS.name} of it is heard"
            for arm, (heard, word) in self._words.items()
        }
        return "; ".join(f"{arm}: {word}" for arm, word in words.items() if word)
