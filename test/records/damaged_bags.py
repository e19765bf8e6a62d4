"""Bags that are cut and flipped, and what each command makes of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer

from tactile_records.bags.contents import Bag
from tactile_records.bags.reader import read_bag
from tactile_records.replay.inputs import inputs_of
from tactile_records.replay.run import run_filter
from tactile_records.replay.sweep import base_settings
from tactile_records.runs import metrics
from tactile_records.runs.from_bag import arms_of, run_from_bag

UNKNOWN_HASH = "RIHS01_" + 64 * "0"  # rosbags knows none of actions


def as_sqlite(bag: Bag, folder: Path) -> Path:
    """The same messages as `ros2 bag record --storage sqlite3` keeps them."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {
            topic: writer.add_connection(topic, name, msgdef=bag.definitions[name], rihs01=UNKNOWN_HASH)
            for topic, name in bag.types.items()
        }
        for message in bag.messages:
            writer.write(connections[message.topic], message.received_ns, message.data)
    return folder


def cuts(size: int, count: int) -> Iterator[tuple[str, int]]:
    """So many places to end a file at, evenly from its start to its end."""
    return (("cut", int(at)) for at in np.linspace(0, size - 1, count))


def flips(size: int, count: int) -> Iterator[tuple[str, int]]:
    """So many bits to turn, drawn: half of them in the first and last 4 kB, where most is at stake."""
    random = np.random.default_rng(11)
    edge = min(4096, size // 4)
    edges = [*range(edge), *range(size - edge, size)]
    drawn = [*random.choice(edges, count // 2), *random.integers(0, size, count - count // 2)]
    return (
        ("flip", 8 * int(at) + int(bit)) for at, bit in zip(drawn, random.integers(0, 8, count), strict=True)
    )


def damage(data: bytes, kind: str, place: int) -> bytes:
    """A file that ends at a byte, or one of whose bits is turned."""
    if kind == "cut":
        return data[:place]
    changed = bytearray(data)
    changed[place // 8] ^= 1 << place % 8
    return bytes(changed)


def outcome(folder: Path, whole: Bag) -> str:
    """What a bag is after damage: "whole", "told", "refused", "altered" or "silent"; other errors are raised.

    "Altered" are messages that were not recorded so: where nothing checks the bytes, that cannot be known.
    """
    try:
        bag = read_bag(folder)
    except ValueError:
        return "refused"
    found, recorded = (Counter((m.topic, m.data) for m in each.messages) for each in (bag, whole))
    if found - recorded:
        return "altered"
    if recorded - found:
        return "silent" if bag.complete else "told"
    return "whole" if bag.complete else "told"


def use(folder: Path) -> None:
    """What `tactile replay` and `tactile report` do with a bag; ValueErrors are their refusals."""
    try:
        bag = read_bag(folder)
        inputs = inputs_of(bag)
        for arm in inputs.arms:
            run_filter(arm, base_settings(inputs, None)[arm.name])
    except ValueError:
        pass
    try:
        bag = read_bag(folder)
        for arm in arms_of(bag):
            metrics.report(run_from_bag(bag, arm))
    except ValueError:
        pass
