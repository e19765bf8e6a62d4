"""Bags larger than memory: what a span of time holds is read when it is asked for.

    bag = SeekableBag(folder)
    for message in bag.between(bag.start_ns, bag.start_ns + SECOND_NS, {"/arm/arm/status"}):
        ...

MCAP files are read chunk by chunk, those of sqlite3 by their index of times; one that is damaged or has no
such index is read as a whole, up to `LARGEST_WHOLE`.
"""

from __future__ import annotations

import heapq
import sqlite3
from bisect import bisect_left
from collections.abc import Collection, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import zstandard

from tactile_records.bags.contents import Bag, BagError, Recorded, everything
from tactile_records.bags.reader import files_of, packed_messages, read_file, read_metadata, unpack_file
from tactile_records.bags.seeking_mcap import SeekingMcap, received
from tactile_records.bags.sqlite import SeekingSqlite
from tactile_records.bags.unpacking import Unpacker

LARGEST_WHOLE = 1_000_000_000  # bytes


class InMemory:
    """Messages of a file that was read as a whole."""

    def __init__(self, messages: list[Recorded]) -> None:
        self._messages = sorted(messages, key=received)
        self.start_ns, self.end_ns = self._messages[0].received_ns, self._messages[-1].received_ns

    def between(
        self, start_ns: int, stop_ns: int, names: Collection[str] | None = None
    ) -> Iterator[Recorded]:
        """Messages of these topics, or of all, with start <= time of reception < stop."""
        first, last = (bisect_left(self._messages, ns, key=received) for ns in (start_ns, stop_ns))
        return (m for m in self._messages[first:last] if names is None or m.topic in names)


Part = SeekingMcap | SeekingSqlite | InMemory  # one file of a bag


class SeekableBag:
    """See the module's text. A file that was compressed as a whole is unpacked into a temporary folder.

    Attributes
    ----------
    contents : Bag
        Note, topics, types and problems; neither messages nor counts.
    start_ns : int
        Time of the first message.

    Raises
    ------
    BagError
        There is no bag at that place, or it holds no message.
    """

    def __init__(self, folder: Path) -> None:
        bag = self.contents = Bag(folder.parent if folder.is_file() else folder)
        information = read_metadata(folder, bag.problems)
        self._packed, self._unpacked = packed_messages(information), list[TemporaryDirectory[str]]()
        opened = [self._open(file) for file in files_of(folder, information, bag.problems)]
        self._parts = [part for part in opened if part is not None]
        if not self._parts:
            raise BagError(f"{folder}: nothing in it can be read ({bag.problem or 'it holds no message'})")
        self.start_ns = min(part.start_ns for part in self._parts)
        bag.note = {str(key): str(value) for key, value in information["custom_data"].items()}

    @property
    def end_ns(self) -> int:
        """Time of the last message."""
        return max(part.end_ns for part in self._parts)

    @property
    def open_ended(self) -> bool:
        """Whether it is still written, or its writer was killed."""
        return any(part.open_ended for part in self._growing())

    def look_again(self) -> bool:
        """Take in what was written since the last look; whether that was anything."""
        return sum(part.look_again() for part in self._growing()) > 0

    def _growing(self) -> Iterator[SeekingMcap]:
        return (part for part in self._parts if isinstance(part, SeekingMcap))

    def between(
        self, start_ns: int, stop_ns: int, names: Collection[str] | None = None
    ) -> Iterator[Recorded]:
        """Messages of these topics, or of all, with start <= time of reception < stop, by that time."""
        parts = (part for part in self._parts if part.start_ns < stop_ns and part.end_ns >= start_ns)
        found = heapq.merge(*(part.between(start_ns, stop_ns, names) for part in parts), key=received)
        return filter(None, map(self._unpack, found)) if self._packed else found

    def _unpack(self, message: Recorded) -> Recorded | None:
        """A message that was compressed by itself; None for a damaged one."""
        try:
            return message._replace(data=Unpacker(len(message.data)).unpack(message.data))
        except (zstandard.ZstdError, ValueError) as error:
            text = f"{message.topic}: a message is damaged: {error}"
            self.contents.problems += [text] if text not in self.contents.problems else []
            return None

    def _open(self, file: Path) -> Part | None:
        """One file; None, and a problem, if it holds nothing readable."""
        if file.suffix == ".zstd":
            self._unpacked.append(TemporaryDirectory(prefix="tactile_bag_"))
            target = Path(self._unpacked[-1].name) / file.stem
            unpack_file(file, target, self.contents.problems, Unpacker(file.stat().st_size))
            return self._open(target)
        if file.suffix != ".db3":
            part = SeekingMcap(file, self.contents)
            return part if part.read() and part.places else None
        try:
            database = SeekingSqlite(file, self.contents)
            return database if database.end_ns else None
        except sqlite3.DatabaseError as error:
            return self._whole(file, str(error))

    def _whole(self, file: Path, why: str) -> Part | None:
        bag, size = self.contents, file.stat().st_size
        if size > LARGEST_WHOLE:
            bag.problems.append(f"{file.name}: {why}; and of {size} bytes it is too large for the memory")
            return None
        bag.wanted = everything
        read_file(file, bag, False, Unpacker(size))
        messages, bag.messages = bag.messages, []
        return InMemory(messages) if messages else None
