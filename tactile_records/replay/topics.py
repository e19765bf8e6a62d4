"""The topics of a bag that a replay reads, decoded; and where their clock goes back.

A clock that is set back, a bag that was recorded from a looped one, a simulation that starts anew: from there
on stamps repeat. Every run of stamps between two jumps is an epoch; events are in the order of (epoch, stamp,
source, sequence). A message of one source may be recorded before the jump shows in another, so that each
source's own stamps decide to which epoch its messages belong, not their place in the file.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.topics import (
    ARM_POSE,
    ESTIMATE,
    FORCE_ESTIMATE,
    PARAMETER_EVENTS,
    PRESENCE,
    STATE,
    TF,
    TF_STATIC,
    TRUTH,
    Topic,
)
from tactile_filter.events import FUTURE_NS, JUMP_NS
from tactile_records.bags.contents import Recorded
from tactile_records.bags.message_columns import ColumnReader, Columns, Needed, pose_columns
from tactile_records.bags.reader import Bag

Array = NDArray[Any]
Stamps = NDArray[np.int64]


NO_STAMP = -1  # of a message that cannot be decoded, or that live nodes refuse


class ReplayError(ValueError):
    """A bag that cannot be replayed; the message says what is missing."""


_HEADER: Needed = {"header.stamp.sec": (), "header.stamp.nanosec": (), "header.frame_id": None}
POSE = pose_columns("pose.pose.position", "pose.pose.orientation")
ARM_POSE_PARTS = pose_columns("pose.position", "pose.orientation")
_NEEDED: dict[Topic, Needed] = {  # what a replay uses of each topic
    ESTIMATE: {**_HEADER, **dict.fromkeys(POSE, ()), "pose.covariance": (36,)},
    PRESENCE: {**_HEADER, "in_contact": ()},
    FORCE_ESTIMATE: {**_HEADER, "force": (3,), "covariance": (9,)},
    STATE: {**_HEADER, "flags": (), "nis": (), "latency.sec": (), "latency.nanosec": ()},
    TRUTH: {**_HEADER, "euler": (6,), "depth": (), "slip_fraction": (), "in_contact": ()},
    ARM_POSE: {**_HEADER, **dict.fromkeys(ARM_POSE_PARTS, ())},
}


def wanted_topics(topic: str, type_name: str) -> bool:
    """Whether a replay from estimates needs a topic."""
    return topic in (TF.name, TF_STATIC.name, PARAMETER_EVENTS.name) or any(
        kind.arm_of(topic) for kind in _NEEDED
    )


def _no_stamps() -> Stamps:
    return np.zeros(0, np.int64)


@dataclass
class Timeline:
    """Stamps (N,) of one source's messages, ns, their places (N,) in the recording, and their epochs (N,)."""

    stamps_ns: Stamps = field(default_factory=_no_stamps)
    order: Stamps = field(default_factory=_no_stamps)
    epochs: Stamps = field(default_factory=_no_stamps, init=False)


@dataclass
class Messages(Timeline):
    """The messages of one topic that could be decoded, in the order of the recording."""

    received_ns: Array = field(default_factory=_no_stamps)
    columns: list[Columns] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.stamps_ns)


class TopicReader:
    """Decodes the topics of a bag."""

    def __init__(self, bag: Bag) -> None:
        self.bag = bag
        self._by_topic: dict[str, list[tuple[int, Recorded]]] = {}
        for order, message in enumerate(bag.messages):
            self._by_topic.setdefault(message.topic, []).append((order, message))

    def with_places(self, *topics: str) -> list[tuple[int, Recorded]]:
        """The messages of some topics, with their places in the recording."""
        return [entry for name in topics for entry in self._by_topic.get(name, [])]

    def topic(self, kind: Topic, arm: str, remarks: list[str]) -> Messages:
        """All messages of an arm's topic; what cannot be decoded goes into `remarks`."""
        name = kind.of(arm).name
        messages = self._by_topic.get(name, [])
        if not messages:
            return Messages()
        type_name = messages[0][1].type
        reader = ColumnReader(self.bag.typestore(type_name).fielddefs, type_name, _NEEDED[kind])
        columns = reader.read([message.data for _, message in messages])
        if reader.unreadable:
            _, reason = reader.unreadable[0]
            remarks.append(
                f"{name}: {len(reader.unreadable)} messages cannot be decoded, the first: {reason}"
            )
        stamps = np.full(len(messages), NO_STAMP, np.int64)
        for group in columns:
            stamps[group.indices] = group.stamps_ns()
        order = np.array([order for order, _ in messages])
        received = np.array([message.received_ns for _, message in messages])
        early = of_the_future(stamps, received)
        if early.any():
            remarks.append(
                f"{name}: {int(early.sum())} messages are stamped ahead of the clock and passed over"
            )
            stamps[early] = NO_STAMP
        return Messages(stamps, order, received, columns)


# ---- the clock ----


@dataclass(frozen=True)
class Jump:
    """The clock went back: by how much, and the newest stamp before it."""

    source: str
    seconds: float
    before_ns: int


def assign_epochs(sources: Mapping[str, Timeline]) -> list[Jump]:
    """Give each message of each source its epoch; returns the jumps between epochs."""
    for timeline in sources.values():
        timeline.epochs = np.zeros_like(timeline.stamps_ns)
    if not any(_jumps(timeline.stamps_ns) for timeline in sources.values()):
        return []
    return _Epochs(sources).assigned()


def split_epochs(sources: Iterable[Timeline], ends: Collection[tuple[int, int]]) -> None:
    """Have an epoch end after a stamp (ns), for each (epoch, stamp); what is later is an epoch of its own."""
    for timeline in sources:
        ended = sum((timeline.epochs == epoch) & (timeline.stamps_ns > stamp) for epoch, stamp in ends)
        timeline.epochs = timeline.epochs * (len(ends) + 1) + ended


def of_the_future(stamps_ns: Stamps, received_ns: Stamps) -> NDArray[np.bool_]:
    """Which stamps lie so far ahead of the clock that live nodes refused them.

    That the recorder's clock as a whole was behind is no fault of a message.
    """
    ahead = stamps_ns - received_ns
    return ahead > max(0.0, float(np.median(ahead))) + FUTURE_NS if len(ahead) else ahead > 0


def _jumps(stamps_ns: Stamps) -> bool:
    stamps_ns = stamps_ns[stamps_ns >= 0]
    return bool((stamps_ns < np.maximum.accumulate(stamps_ns) - JUMP_NS).any())


class _Epochs:
    """Goes through all messages in the order of the recording."""

    def __init__(self, sources: Mapping[str, Timeline]) -> None:
        self.sources = sources
        self.newest: dict[str, int] = {}  # stamp by source, within its epoch
        self.epoch: dict[str, int] = {}
        self.newest_of_epoch = [0]
        self.found: list[Jump] = []

    def assigned(self) -> list[Jump]:
        rows = [
            (int(order), name, row, int(stamp_ns))
            for name, timeline in self.sources.items()
            for row, (order, stamp_ns) in enumerate(zip(timeline.order, timeline.stamps_ns, strict=True))
            if stamp_ns >= 0
        ]
        for _, name, row, stamp_ns in sorted(rows):
            self.sources[name].epochs[row] = self._take(name, stamp_ns)
        return self.found

    def _take(self, name: str, stamp_ns: int) -> int:
        current = len(self.newest_of_epoch) - 1
        epoch = self.epoch.get(name, current)
        newest_ns = self.newest.get(name, stamp_ns)
        if stamp_ns < newest_ns - JUMP_NS:
            if epoch == current:
                self.found.append(Jump(name, (newest_ns - stamp_ns) * 1e-9, newest_ns))
                self.newest_of_epoch.append(stamp_ns)
            epoch = len(self.newest_of_epoch) - 1
            newest_ns = stamp_ns
        elif epoch < current and self._is_nearer(stamp_ns, current, epoch):
            epoch, newest_ns = current, stamp_ns
        self.epoch[name], self.newest[name] = epoch, max(newest_ns, stamp_ns)
        self.newest_of_epoch[epoch] = max(self.newest_of_epoch[epoch], stamp_ns)
        return epoch

    def _is_nearer(self, stamp_ns: int, one: int, other: int) -> bool:
        """A source that was silent over the jump shows no jump of its own."""
        newest = self.newest_of_epoch
        return abs(stamp_ns - newest[one]) < abs(stamp_ns - newest[other])
