"""What a controller hears of others while it works: of the nodes before it, and of the arms it works with."""

from __future__ import annotations

import functools
import math
import re
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from tactile_base import topics
from tactile_base.stamps import SECOND_NS
from tactile_control.partners import Partners, Word
from tactile_control.phases import DONE, FAILED, StampedPose
from tactile_geometry import se3
from tactile_msgs.msg import ControllerStatus
from tactile_records.messages import IDLE
from tactile_ros.qos import DIAGNOSTICS, STATE
from tactile_wire.cdr import MessageReader, layout_of
from tactile_wire.message_definitions import type_fields

if TYPE_CHECKING:
    from tactile_ros.managed_node import ManagedNode

_NUMBER = re.compile(r"[-+]?\d[\d.e+-]*")

#: Between the exposure of an image and a motion, in this order, below the arm's namespace.
_CHAIN = ("camera", "estimator", "filter", "arm")
_NEW = 5.0  # s; what is complained about for longer has done no harm before
_LOST = re.compile(r"\d+ lost so far")  # of single messages: no reason for an input that does not come at all
_IDLE = ("inactive", "unconfigured")  # what a node says that was deactivated
_SILENT = 1.2  # s; every node reports once a second


class Upstream:
    """What the nodes complain about in /diagnostics that a task gets its inputs from."""

    def __init__(self, node: ManagedNode) -> None:
        namespace = node.get_namespace().rstrip("/")
        self._names = [f"{namespace}/{name}" for name in _CHAIN]
        self._marks = [name.encode() + b"\0" for name in self._names]
        self._said: dict[str, _Complaint] = {}
        self._heard: dict[str, float] = {}
        self._fields = type_fields(topics.DIAGNOSTICS.type)
        node.subscribe(DiagnosticArray, topics.DIAGNOSTICS.name, self._take, DIAGNOSTICS, raw=True)

    @property
    def cause(self) -> str:
        """The most likely reason for an input that is missing, and whose; empty where it is not known.

        A node that says nothing at all any more, being held up or dead, or that was deactivated; else of
        complaints that are new the first on the way from the image to the arm; else of all others.
        """
        now = time.monotonic()
        for name, heard in self._heard.items():
            if now - heard > _SILENT:
                return f"{name} has not been heard of for {now - heard:.1f} s"
        found = [self._said[name] for name in self._names if name in self._said]
        new = [complaint for complaint in found if now - complaint.since_s < _NEW]
        idle = [complaint for complaint in found if complaint.kind in _IDLE]
        return next((complaint.text for complaint in idle or new or found), "")

    def _take(self, data: bytes) -> None:
        """Most of what arrives is of other nodes, of which nothing is read."""
        if not any(mark in data for mark in self._marks):
            return
        layout = layout_of(self._fields, topics.DIAGNOSTICS.type, data)
        numbers = layout.unpack(data)
        for index in range(layout.lengths["status"]):
            name = layout.texts[f"status.{index}.name"]
            if name in self._names:
                level = bytes([numbers[layout.place(f"status.{index}.level").start]])
                self._hear(name, layout.texts[f"status.{index}.message"], level != DiagnosticStatus.OK)

    def _hear(self, name: str, message: str, complains: bool) -> None:
        before, kind = self._said.pop(name, None), _NUMBER.sub("", message)
        self._heard[name] = time.monotonic()
        if message in _IDLE:
            complains, message = True, f"it is {message}"
        message = "; ".join(part for part in message.split("; ") if not _LOST.search(part))
        if complains and message:
            goes_on = before is not None and before.kind == kind
            since_s = before.since_s if before is not None and goes_on else time.monotonic()
            self._said[name] = _Complaint(f"{name}: {message}", kind, since_s)


@dataclass(frozen=True)
class _Complaint:
    """What a node says, the same without numbers, and since when."""

    text: str
    kind: str
    since_s: float


def listen_to_partners(node: ManagedNode, partners: Partners) -> None:
    """Have partners hear what the controller of each says in its status, by the steady clock."""
    read = MessageReader(topics.CONTROLLER_STATUS.type)

    def take(arm: str, data: bytes) -> None:
        layout, numbers = read(data)
        over = layout.texts["phase"] in (IDLE, DONE, FAILED)
        at_work = bool(numbers[layout.place("at_work").start])
        hold = numbers[layout.place("hold")]
        seconds, nanoseconds = map(int, numbers[layout.place("hold_stamp")])
        stamp_ns, place = seconds * SECOND_NS + nanoseconds, None
        if stamp_ns and all(map(math.isfinite, hold)):
            place = StampedPose(stamp_ns, se3.exp(hold))
        partners.hear(arm, time.monotonic(), Word(over, at_work, layout.texts["trouble"], place))

    for arm in partners.arms:
        topic = topics.CONTROLLER_STATUS.of(arm).name
        node.subscribe(ControllerStatus, topic, functools.partial(take, arm), STATE, raw=True)
