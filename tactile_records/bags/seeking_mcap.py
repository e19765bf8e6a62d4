"""Reads MCAP files larger than memory: what a span of time holds, when it is asked for.

When a file is opened, its chunks are only listed, with their times and channels: from the summary at the
file's end or, where its writer was killed or still writes, by going from record to record. A chunk is read as
a whole, and those read last are kept. Format: https://mcap.dev/spec
"""

from __future__ import annotations

import os
import struct
from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from tactile_records.bags.contents import Bag, Recorded
from tactile_records.bags.mcap import DAMAGE, MESSAGE, OPCODES, RECORD, WITHOUT_FOOTER, McapReader, text_of
from tactile_records.bags.unpacking import ALLOWED, MESSAGE_COST, Unpacker

KEPT = 256_000_000  # bytes of chunks, unpacked
LARGEST = 1_000_000_000  # bytes, of a chunk
MOST_TOLD = 10  # damages
RUN = 1_000_000  # bytes; so many of messages outside of chunks are read at once
_SPAN = struct.Struct("<QQ")  # first and last time, with which the content of a chunk begins
_CHANNEL = struct.Struct("<H")  # with which the content of a message index begins
received = attrgetter("received_ns")


@dataclass
class Place:
    """Where messages stand: a chunk, its part before the file's end, or a run of them outside of chunks.

    `channels` that have messages there are none where the file does not tell them beside it.
    """

    at: int
    stop: int
    start_ns: int
    end_ns: int
    kind: str = "chunk"
    channels: set[int] = field(default_factory=set)


class FileBytes:
    """A file whose slices are read from it; of a mapped one what was read counts as memory in use."""

    def __init__(self, path: Path) -> None:
        self._stream = path.open("rb", buffering=0)
        self._size = path.stat().st_size

    def __len__(self) -> int:
        return self._size

    def look_again(self) -> bool:
        """Whether the file is larger than when this was asked last."""
        before, self._size = self._size, os.fstat(self._stream.fileno()).st_size
        return self._size > before

    def __getitem__(self, part: slice) -> bytes:
        start, stop, _ = part.indices(self._size)
        return os.pread(self._stream.fileno(), max(0, stop - start), start)


class SeekingMcap(McapReader):
    """One file. `bag` gets types, topics and problems, but neither messages nor counts.

    Attributes
    ----------
    places : list of Place
        By the time of their first message.
    """

    def __init__(self, file: Path, bag: Bag) -> None:
        self._file = FileBytes(file)
        super().__init__(self._file, file.name, bag, Unpacker(0))
        self.places: list[Place] = []
        self._position = len(MCAP0_MAGIC)  # how far it was scanned
        self._latest: Place | None = None  # that was found
        self._early_end = ""
        self._kept: OrderedDict[int, list[Recorded]] = OrderedDict()
        self._size = 0  # of what is kept, bytes
        self._told: set[int] = set()  # places whose damage was told

    @property
    def start_ns(self) -> int:
        """Time of the first message."""
        return self.places[0].start_ns

    @property
    def end_ns(self) -> int:
        """Time of the last message."""
        return max(place.end_ns for place in self.places)

    def read(self) -> bool:
        """List what is where; False if it is no MCAP file or holds nothing at all."""
        if not self._starts():
            return False
        self._read_summary()
        counted = self._statistics is not None and self._statistics.chunk_count == len(self._chunks) > 0
        self._list(self._list_chunks if counted else self._scan)
        return bool(self._channels) or not self._bag.problems

    def look_again(self) -> bool:
        """List also what was written since; whether that was anything."""
        if not (self.open_ended and self._file.look_again()):
            return False
        self._bag.problems.remove(self._early_end)
        self._early_end = ""
        for place in self.places:
            if place.kind == "part" or place is self._latest:  # more of it may be there now
                self._size -= _cost(self._kept.pop(place.at, []))
        self.places = [place for place in self.places if place.kind != "part"]
        self._read_summary()
        self._list(self._scan)
        return True

    @property
    def open_ended(self) -> bool:
        """Whether its end is missing, as long as it is written."""
        return bool(self._early_end)

    def _list(self, look: Callable[[], None]) -> None:
        try:
            look()
        except DAMAGE as error:
            self._report(f"damaged, shown as far as it goes: {text_of(error)}")
        for place in self.places:
            announced = self._channels and place.channels <= self._channels.keys()
            if place.kind == "part" or not announced:
                found = self._messages(place)
                place.end_ns = found[-1].received_ns if found else 0
        self.places = sorted((place for place in self.places if place.end_ns), key=attrgetter("start_ns"))

    def between(
        self, start_ns: int, stop_ns: int, names: Collection[str] | None = None
    ) -> Iterator[Recorded]:
        """Messages of these topics, or of all, with start <= time of reception < stop, by that time."""
        waiting: list[Recorded] = []
        for place in self.places:
            if place.end_ns < start_ns or place.start_ns >= stop_ns or not self._may_hold(place, names):
                continue
            ready = bisect_left(waiting, place.start_ns, key=received)
            yield from waiting[:ready]
            found = self._of(place, names)
            part = slice(*(bisect_left(found, limit, key=received) for limit in (start_ns, stop_ns)))
            waiting = sorted(waiting[ready:] + found[part], key=received)
        yield from waiting

    # ---- what is where ----

    def _may_hold(self, place: Place, names: Collection[str] | None) -> bool:
        topics = self._channels
        return (
            names is None
            or not place.channels
            or any(topics[number][0] in names for number in place.channels if number in topics)
        )

    def _list_chunks(self) -> None:
        for at, chunk in self._chunks.items():
            span = chunk.message_start_time, chunk.message_end_time
            channels = set(chunk.message_index_offsets)
            self.places.append(Place(at, at + chunk.chunk_length, *span, channels=channels))
        for index in self._metadata:
            self._take(Opcode.METADATA, index.offset, index.offset + index.length)

    def _scan(self) -> None:
        """From record to record; of chunks only their times are read, and which channels they have.

        It goes on where it ended the last time, with the record that was not whole then.
        """
        size, whole, opcode = len(self._data), True, 0
        while whole and opcode != Opcode.DATA_END and self._position + MESSAGE.size <= size:
            at = self._position
            head = self._data[at : at + MESSAGE.size]
            opcode, length = RECORD.unpack_from(head)
            stop = at + RECORD.size + length
            whole = opcode in OPCODES and stop <= size
            if opcode == Opcode.CHUNK and (whole or size - at < ALLOWED):
                start_ns, end_ns = _SPAN.unpack_from(head, RECORD.size)
                kind = "chunk" if whole else "part"
                self._add(Place(at, min(stop, size), start_ns, end_ns, kind))
            elif whole and opcode == Opcode.MESSAGE_INDEX and self._latest is not None:
                self._latest.channels.update(_CHANNEL.unpack_from(head, RECORD.size))
            elif whole and opcode == Opcode.MESSAGE:
                self._add_message(at, stop, head)
            elif whole and opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
                self._take(opcode, at, stop)
            self._position = stop if whole else at
        if not self._has_end:
            self._report(f"the file ends early, after {size} bytes and {WITHOUT_FOOTER}")
            self._early_end = self._bag.problems[-1]
        elif not whole:
            self._report(
                f"damaged near byte {self._position} of {size}: no record of MCAP; the rest is not shown"
            )

    def _add_message(self, at: int, stop: int, head: bytes) -> None:
        """One outside of a chunk; adjacent ones make a place."""
        channel, _, received_ns, _ = MESSAGE.unpack(head)[2:]
        last = self._latest
        if last is None or last.kind != "run" or last.stop != at or at - last.at > RUN:
            last = self._add(Place(at, stop, received_ns, received_ns, "run"))
        last.stop = stop
        last.start_ns, last.end_ns = min(last.start_ns, received_ns), max(last.end_ns, received_ns)
        last.channels.add(channel)

    def _add(self, place: Place) -> Place:
        self.places.append(place)
        self._latest = place
        return place

    # ---- what is in it ----

    def _of(self, place: Place, names: Collection[str] | None) -> list[Recorded]:
        """Messages of a place by their time; the places of which all were read last are kept."""
        if place.at in self._kept:
            self._kept.move_to_end(place.at)
            found = self._kept[place.at]
            return found if names is None else [message for message in found if message.topic in names]
        if names is not None:
            return self._messages(place, names)
        found = self._kept[place.at] = self._messages(place)
        self._size += _cost(found)
        while self._size > KEPT and len(self._kept) > 1:
            self._size -= _cost(self._kept.popitem(last=False)[1])
        return found

    def _messages(self, place: Place, names: Collection[str] | None = None) -> list[Recorded]:
        """Messages of a place by their time; what cannot be read is told once, with as much as was read."""
        bag, self._unpacker = self._bag, Unpacker(place.stop - place.at)
        bag.messages, bag.wanted = [], lambda topic, type_name: names is None or topic in names
        for number, (topic, type_name, _) in self._channels.items():
            self._channels[number] = topic, type_name, bag.wanted(topic, type_name)
        try:
            if place.stop - place.at > LARGEST:
                raise ValueError(f"{place.stop - place.at} bytes in one piece, at most {LARGEST} are read")
            if place.kind == "chunk":
                self._take(Opcode.CHUNK, place.at, place.stop)
            elif place.kind == "part":
                self._take_part_of_chunk(place.at)
            else:
                self._take_records(self._data[place.at : place.stop])
        except DAMAGE as error:
            if len(self._told) < MOST_TOLD and place.at not in self._told:
                self._told.add(place.at)
                self._report(f"damaged near byte {place.at} of {len(self._data)}: {text_of(error)}")
        found, bag.messages = sorted(bag.messages, key=received), []
        bag.counts = dict.fromkeys(bag.counts, 0)
        return found


def _cost(messages: list[Recorded]) -> int:
    return sum(len(message.data) for message in messages) + MESSAGE_COST * len(messages)
