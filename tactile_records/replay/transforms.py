"""The sensor's poses over a whole recording, from its /tf and /tf_static, at stamps that are asked for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import NANOSECOND
from tactile_base.topics import TF, TF_STATIC
from tactile_geometry.transform_buffer import STAMP_SLACK, MotionLimits, TransformBuffer, TransformUnavailable
from tactile_records.bags.contents import Recorded
from tactile_records.bags.message_columns import (
    ColumnReader,
    Columns,
    Needed,
    lacking,
    pose_columns,
    stamps_ns,
)
from tactile_records.replay.topics import Timeline, of_the_future
from tactile_wire.pose_numbers import are_poses, pose_from_numbers

Array = NDArray[Any]

FOREVER_NS = 2**62
PARTS = pose_columns("translation", "rotation")
_NEEDED: Needed = {"header.stamp.sec": (), "header.stamp.nanosec": ()} | {
    **dict.fromkeys(("header.frame_id", "child_frame_id")),
    **{f"transform.{part}": () for part in PARTS},
}


@dataclass
class Link(Timeline):
    """All transforms of one child, in the order of the recording: also their parents, and numbers (N, 7)."""

    parents: list[str] = field(default_factory=list)
    numbers: Array = field(default_factory=lambda: np.zeros((0, 7)))


@dataclass
class Recording:
    """The transforms of a recording.

    Attributes
    ----------
    moving, static : dict
        Child -> its transforms.
    refused : Counter
        Child -> transforms that are none (norm of the quaternion, not finite).
    early : Counter
        Child -> transforms that are stamped ahead of the clock, which live nodes refuse.
    unreadable : list of str
        Messages that could not be decoded, and why.
    changed : list of str
        Children whose static transform changes during the recording; the last one is taken.
    """

    moving: dict[str, Link] = field(default_factory=dict)
    static: dict[str, Link] = field(default_factory=dict)
    refused: Counter[str] = field(default_factory=Counter)
    early: Counter[str] = field(default_factory=Counter)
    unreadable: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)


def read_transforms(
    fields: Any, messages: Sequence[tuple[int, Recorded]], ignore: Collection[str] = ()
) -> Recording:
    """The transforms in messages of /tf and /tf_static, given with their places in the recording.

    Parameters
    ----------
    fields : mapping
        Definitions of types, see `ColumnReader`.
    ignore : collection of str
        Children that are passed over: the beliefs of filters, which are an output.
    """
    recording = Recording()
    for static in (False, True):
        topic = (TF_STATIC if static else TF).name
        chosen = [(order, message) for order, message in messages if message.topic == topic]
        if chosen:
            links = _links(fields, chosen, ignore, recording, static)
            (recording.static if static else recording.moving).update(links)
    for child, link in recording.static.items():
        if (link.numbers != link.numbers[-1]).any() or set(link.parents) != {link.parents[-1]}:
            recording.changed.append(child)
    return recording


def _links(
    fields: Any,
    messages: list[tuple[int, Recorded]],
    ignore: Collection[str],
    recording: Recording,
    static: bool,
) -> dict[str, Link]:
    orders = np.array([order for order, _ in messages])
    received = np.array([message.received_ns for _, message in messages])
    reader = ColumnReader(fields, messages[0][1].type)
    parts: dict[str, list[tuple[Array, Array, str, Array]]] = {}
    for columns in reader.read([message.data for _, message in messages]):
        for stamps, parent, child, numbers in _transforms(columns, recording.unreadable):
            early = (
                np.zeros(len(stamps), bool) if static else of_the_future(stamps, received[columns.indices])
            )
            recording.early[child] += int(early.sum())
            if child not in ignore:
                piece = orders[columns.indices][~early], stamps[~early], parent, numbers[~early]
                parts.setdefault(child, []).append(piece)
    recording.unreadable += [reason for _, reason in reader.unreadable]
    return {child: _link(pieces, child, recording.refused) for child, pieces in parts.items()}


def _transforms(columns: Columns, unreadable: list[str]) -> Iterable[tuple[Array, str, str, Array]]:
    """Stamps, parent, child and numbers of each of the transforms that the messages of a layout have."""
    texts = columns.layout.texts
    for index in range(columns.layout.lengths.get("transforms", 1)):
        prefix = f"transforms.{index}"
        if missing := lacking(columns.layout, {f"{prefix}.{name}": shape for name, shape in _NEEDED.items()}):
            unreadable += [f"they have no {missing}"] * len(columns.indices)
            return
        parent, child = texts[f"{prefix}.header.frame_id"], texts[f"{prefix}.child_frame_id"]
        numbers = columns.stack([f"{prefix}.transform.{part}" for part in PARTS])
        stamps = stamps_ns(columns.values, f"{prefix}.header.stamp")
        yield stamps, parent.removeprefix("/"), child.removeprefix("/"), numbers


def _link(pieces: list[tuple[Array, Array, str, Array]], child: str, refused: Counter[str]) -> Link:
    order = np.concatenate([piece[0] for piece in pieces])
    stamps = np.concatenate([piece[1] for piece in pieces])
    parents = [parent for places, _, parent, _ in pieces for _ in places]
    numbers = np.concatenate([piece[3] for piece in pieces])
    sound = are_poses(numbers)
    if not sound.all():
        refused[child] += int((~sound).sum())
    rows = np.flatnonzero(sound)
    rows = rows[np.argsort(order[rows], kind="stable")]
    return Link(stamps[rows], order[rows], [parents[row] for row in rows], numbers[rows])


def between(recording: Recording, target: str, source: str) -> Recording:
    """Only the moving links that lookups between two frames depend on, each a copy."""
    chain = _chain(recording, target) | _chain(recording, source)
    moving = {child: replace(link) for child, link in recording.moving.items() if child in chain}
    return replace(recording, moving=moving)


@dataclass(frozen=True)
class Restart:
    """A frame that jumped and stayed: in which epoch, and the last stamp at which it was at its old place."""

    epoch: int
    before_ns: int
    reason: str


def refuse_jumps(link: Link, child: str, limits: MotionLimits) -> tuple[int, list[Restart]]:
    """Leave out of the link what live nodes refused because it jumped; how many, and where it stayed."""
    kept, restarts = np.ones(len(link.stamps_ns), bool), []
    for epoch in np.unique(link.epochs):
        rows = np.flatnonzero(link.epochs == epoch)
        if _is_smooth(link, rows, limits):
            continue
        poses = pose_from_numbers(link.numbers[rows])
        buffer, away = TransformBuffer(FOREVER_NS, FOREVER_NS, limits), list[int]()
        newest_ns = int(link.stamps_ns[rows[0]])
        for row, stamp_ns, T in zip(rows.tolist(), link.stamps_ns[rows].tolist(), poses, strict=True):
            try:
                reason = buffer.set_transform(link.parents[row], child, stamp_ns, T)
            except ValueError:
                kept[row] = False
                away.append(row)
                continue
            if reason:  # with the transforms before this one that agreed with it
                restarts.append(Restart(int(epoch), newest_ns, reason))
                since_ns = buffer.stamps(child)[0]
                kept[[each for each in away if link.stamps_ns[each] >= since_ns]] = True
            newest_ns = stamp_ns if reason else max(newest_ns, stamp_ns)
            away.clear()
    rows = np.flatnonzero(kept)
    link.parents = [link.parents[row] for row in rows]
    link.stamps_ns, link.order, link.epochs = link.stamps_ns[rows], link.order[rows], link.epochs[rows]
    link.numbers = link.numbers[rows]
    return int((~kept).sum()), restarts


def _is_smooth(link: Link, rows: Array, limits: MotionLimits) -> bool:
    """Whether these transforms are in order and, with room to spare, as slow as they have to be."""
    stamps, numbers = link.stamps_ns[rows], link.numbers[rows]
    if len({link.parents[row] for row in rows}) > 1 or (np.diff(stamps) <= 0).any():
        return False
    elapsed = 0.9 * (np.diff(stamps) * NANOSECOND + STAMP_SLACK)
    way = np.linalg.norm(np.diff(numbers[:, :3], axis=0), axis=1)
    q = numbers[:, 3:] / np.linalg.norm(numbers[:, 3:], axis=1, keepdims=True)
    angle = 2.0 * np.arccos(np.minimum(np.abs((q[1:] * q[:-1]).sum(axis=1)), 1.0))
    return bool(
        (way < limits.largest_speed * elapsed).all() and (angle < limits.largest_turn_rate * elapsed).all()
    )


def poses_at(
    recording: Recording, target: str, source: str, stamps: Array, epoch: int
) -> list[Array | TransformUnavailable]:
    """T_target_source (4, 4) at each stamp of an epoch, or why there is none.

    A lookup touches the transforms next to its stamp only, so no others are put into the buffer: it answers
    as one that holds all of them.
    """
    buffer = TransformBuffer(history_ns=FOREVER_NS, jump_ns=FOREVER_NS)
    for child, link in recording.static.items():
        _put(buffer, child, link, [len(link.stamps_ns) - 1], static=True)
    chain = _chain(recording, target) | _chain(recording, source)
    for child in sorted(chain & recording.moving.keys()):
        link = recording.moving[child]
        rows = np.flatnonzero(link.epochs == epoch)
        if len(rows):
            _put(buffer, child, link, _neighbors(link, rows, stamps), static=False)
    found: list[Array | TransformUnavailable] = []
    for stamp_ns in stamps.tolist():
        try:
            found.append(buffer.lookup(target, source, stamp_ns))
        except TransformUnavailable as error:
            found.append(error)
    return found


def _put(buffer: TransformBuffer, child: str, link: Link, rows: list[int], static: bool) -> None:
    poses = pose_from_numbers(link.numbers[rows])
    for row, stamp_ns, T in zip(rows, link.stamps_ns[rows].tolist(), poses, strict=True):
        try:
            buffer.set_transform(link.parents[row], child, stamp_ns, T, static=static)
        except ValueError:  # a loop or a nameless frame: live nodes refuse it as well
            continue


def connected(recording: Recording, target: str, source: str) -> bool:
    """Whether any chain of transforms, of whatever time, connects the two frames."""
    return bool(_chain(recording, target) & _chain(recording, source))


def follow_pose(
    recording: Recording, stamps: Array, order: Array, base: str, sensor: str, numbers: Array
) -> None:
    """Take the sensor's poses (N, 7) in its base in the place of its transforms."""
    recording.static.pop(sensor, None)
    sound = np.flatnonzero(are_poses(numbers))
    recording.moving[sensor] = Link(stamps[sound], order[sound], [base] * len(sound), numbers[sound])


def _chain(recording: Recording, frame: str) -> set[str]:
    """The frame and all that it has ever hung from."""
    chain, waiting = set(), [frame]
    while waiting:
        child = waiting.pop()
        if child in chain:
            continue
        chain.add(child)
        for links in (recording.moving, recording.static):
            if child in links:
                waiting += set(links[child].parents)
    return chain


def _neighbors(link: Link, rows: Array, stamps: Array) -> list[int]:
    """The rows of the link that lookups at the stamps need, in the order of the recording."""
    if len({link.parents[row] for row in rows}) > 1:
        return list(map(int, rows))  # a frame that changes its parent: what holds depends on all that came
    by_stamp = rows[np.argsort(link.stamps_ns[rows], kind="stable")]  # of equal stamps the last one holds
    known = link.stamps_ns[by_stamp]
    after = np.searchsorted(known, stamps, side="right")
    first_after = np.searchsorted(known, stamps, side="left")
    near = np.concatenate([after - 1, first_after, first_after - 1, [0, len(known) - 1]])
    near = np.unique(near[(near >= 0) & (near < len(known))])
    return list(map(int, np.sort(by_stamp[near])))
