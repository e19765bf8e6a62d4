"""The topics of a bag that a replay reads, decoded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_records.bags.contents import Recorded
from tactile_records.bags.message_columns import ColumnReader, Columns
from tactile_records.bags.message_definitions import type_fields
from tactile_records.bags.reader import Bag
from tactile_records.replay.clock import Timeline
from tactile_records.replay.settings import PARAMETER_EVENTS
from tactile_records.replay.transforms import Recording, read_transforms

Array = NDArray[Any]

TRANSFORMS = ("/tf", "/tf_static")
ESTIMATE, PRESENCE, STATE, TRUTH = "contact/estimate", "contact/presence", "contact/state", "sim/truth"
ARM_POSE = "arm/pose"
ARM_TOPICS = (ESTIMATE, PRESENCE, STATE, TRUTH, ARM_POSE)


class ReplayError(ValueError):
    """A bag that cannot be replayed; the message says what is missing."""


def wanted_topics(topic: str, type_name: str) -> bool:
    """Whether a replay from estimates needs a topic."""
    return topic in (*TRANSFORMS, PARAMETER_EVENTS) or topic.endswith(
        tuple(f"/{name}" for name in ARM_TOPICS)
    )


@dataclass
class Topic:
    """The messages of one topic that could be decoded, in the order of the recording."""

    stamps_ns: Array = field(default_factory=lambda: np.zeros(0, np.int64))
    order: Array = field(default_factory=lambda: np.zeros(0, np.int64))
    received_ns: Array = field(default_factory=lambda: np.zeros(0, np.int64))
    columns: list[Columns] = field(default_factory=list)
    epochs: Array = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def timeline(self) -> Timeline:
        return Timeline(self.stamps_ns, self.order)

    def __len__(self) -> int:
        return len(self.stamps_ns)


class TopicReader:
    """Decodes the topics of a bag."""

    def __init__(self, bag: Bag) -> None:
        self.bag = bag
        self._by_topic: dict[str, list[tuple[int, Recorded]]] = {}
        for order, message in enumerate(bag.messages):
            self._by_topic.setdefault(message.topic, []).append((order, message))

    def arm_names(self) -> set[str]:
        suffix = f"/{ESTIMATE}"
        return {topic[1 : -len(suffix)] for topic in self.bag.types if topic.endswith(suffix)}

    def topic(self, name: str, remarks: list[str]) -> Topic:
        """All messages of a topic; what cannot be decoded is told in `remarks`."""
        messages = self._by_topic.get(name, [])
        if not messages:
            return Topic()
        reader = ColumnReader(type_fields(self.bag.definitions, messages[0][1].type), messages[0][1].type)
        columns = reader.read([message.data for _, message in messages])
        if reader.unreadable:
            _, reason = reader.unreadable[0]
            remarks.append(
                f"{name}: {len(reader.unreadable)} messages cannot be decoded, the first: {reason}"
            )
        stamps = np.full(len(messages), -1, np.int64)
        for group in columns:
            stamps[group.indices] = group.stamps_ns()
        order = np.array([order for order, _ in messages])
        received = np.array([message.received_ns for _, message in messages])
        return Topic(stamps, order, received, columns)

    def transforms(self, ignore: Sequence[str]) -> Recording:
        messages = [entry for name in TRANSFORMS for entry in self._by_topic.get(name, [])]
        if not messages:
            return Recording()
        return read_transforms(type_fields(self.bag.definitions, messages[0][1].type), messages, ignore)
