"""Reads the sqlite3 files of `ros2 bag`; of damaged and truncated ones the rows that sqlite still finds.

A large file has the page by which its messages are found in its middle. Where that is lost, or one that it
leads to, sqlite is given every page that holds rows as if it were the whole table.
"""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

from tactile_records.bags.contents import Bag, Recorded
from tactile_records.bags.unpacking import MESSAGE_COST, TooLarge, Unpacker

_LEAF = b"\r"  # first byte of a page that holds rows of a table
_MESSAGES = "SELECT id, topic_id, timestamp, data FROM messages"
_SENSIBLE = "WHERE typeof(id) || typeof(timestamp) || typeof(data) = 'integerintegerblob'"
_MOVE = "UPDATE sqlite_master SET rootpage = ? WHERE name = 'messages'"


def _connected(file: Path) -> sqlite3.Connection:
    """The file, opened to be read."""
    # A bag whose recorder was killed may have its last rows in a write-ahead log, which only a reader that
    # takes part in the locking sees.
    mode = "mode=ro" if file.with_name(f"{file.name}-wal").exists() else "immutable=1"
    return sqlite3.connect(f"file:{quote(str(file))}?{mode}", uri=True)


class SeekingSqlite:
    """One file whose messages are found by their time; `bag` gets types, topics and problems.

    Raises `sqlite3.DatabaseError` for one that is damaged, or has no index of times.
    """

    def __init__(self, file: Path, bag: Bag) -> None:
        self._name, self._bag = file.name, bag
        if (missing := _pages_of(file)[1]) > 0:
            raise sqlite3.DatabaseError(f"{missing} bytes of it are missing")
        self._database = _connected(file)
        _refuse_computed(self._database)
        if not any(self._begins_with_time(name) for _, name, *_ in self._rows("PRAGMA index_list(messages)")):
            raise sqlite3.DatabaseError("it has no index of timestamps")
        faults = list[str]()
        self._topics = _read_topics(self._database, bag, faults)
        _read_definitions(self._database, bag, faults)
        bag.problems += [f"{file.name}: damaged: {fault}" for fault in faults]
        self.start_ns, self.end_ns = (
            next(self._rows(f"SELECT {which}(timestamp) FROM messages"))[0] or 0 for which in ("MIN", "MAX")
        )

    def _rows(self, query: str, *values: int) -> Iterator[tuple[Any, ...]]:
        return self._database.execute(query, values)

    def _begins_with_time(self, index: str) -> bool:
        columns = self._database.execute("SELECT name FROM pragma_index_info(?)", (index,))
        return next(iter(columns), None) == ("timestamp",)

    def between(
        self, start_ns: int, stop_ns: int, names: Collection[str] | None = None
    ) -> Iterator[Recorded]:
        """Messages of these topics, or of all, with start <= time of reception < stop, by that time."""
        chosen = [number for number, (name, _) in self._topics.items() if names is None or name in names]
        query = (
            "SELECT topic_id, timestamp, data FROM messages WHERE timestamp >= ? AND timestamp < ? "
            f"AND topic_id IN ({', '.join('?' * len(chosen))}) ORDER BY timestamp"
        )
        try:
            for number, stamp_ns, data in self._rows(query, start_ns, stop_ns, *chosen):
                if isinstance(stamp_ns, int) and isinstance(data, bytes):
                    yield Recorded(*self._topics[number], data, stamp_ns, stamp_ns)
        except sqlite3.DatabaseError as error:
            self._bag.problems.append(f"{self._name}: damaged: {error}")


def read_sqlite(file: Path, bag: Bag, unpacker: Unpacker) -> bool:
    """Read one file into `bag`, as far as `unpacker` allows; False if nothing in it can be read."""
    before, faults = bag.read, list[str]()
    try:
        with closing(_connected(file)) as database:
            database.execute("PRAGMA writable_schema = ON")  # else a truncated file is refused as a whole
            _refuse_computed(database)
            topics = _read_topics(database, bag, faults)
            _read_definitions(database, bag, faults)
            kept = {number: bag.wanted(*topic) for number, topic in topics.items()}
            for number, stamp_ns, data in _rows(database, file, topics.keys(), faults):
                topic, type_name = topics[number]
                bag.counts[topic] += 1
                if kept[number]:
                    unpacker.take(len(data) + MESSAGE_COST)
                    bag.messages.append(Recorded(topic, type_name, data, stamp_ns, stamp_ns))
    except TooLarge as error:
        faults.append(str(error))
    except sqlite3.DatabaseError as error:
        bag.problems.append(f"{file.name}: {'; '.join([*faults, str(error)])}")
        return bag.read > before
    if faults:
        read = bag.read - before
        found = f"{read} messages of it were read, `sqlite3 {file.name} .recover` may find more"
        bag.problems.append(f"{file.name}: damaged: {'; '.join(dict.fromkeys(faults))}; {found}")
        return read > 0
    return True


def _rows(
    database: sqlite3.Connection, file: Path, topics: Collection[int], faults: list[str]
) -> Iterator[tuple[int, int, bytes]]:
    """Topic, stamp (ns) and data of the messages by their ids; page by page where sqlite meets damage."""
    page, missing = _pages_of(file)
    last, senseless = 0, list[str]()
    try:
        if missing > 0:  # of a page that the end cuts sqlite would make messages that end in zeros
            raise sqlite3.DatabaseError(f"the file ends early, {missing} bytes of it are missing")
        for number, topic, stamp_ns, data in database.execute(f"{_MESSAGES} ORDER BY id"):
            types = type(number), type(stamp_ns), type(data)
            if types[0] is int and number <= last:
                raise sqlite3.DatabaseError(f"row {number} comes after row {last}")
            if topic in topics and types == (int, int, bytes):
                last = number
                yield topic, stamp_ns, data
            else:
                senseless.append(f"{number!r:.40}")
    except sqlite3.DatabaseError as error:
        faults.append(str(error))
        for number, topic, stamp_ns, data in _rows_of_pages(file, page):
            if number > last and topic in topics:  # there may be older ones, of a page that was given up
                last = number
                yield topic, stamp_ns, data
    if senseless:
        faults.append(f"{len(senseless)} rows of messages make no sense, the first with id {senseless[0]}")


def _pages_of(file: Path) -> tuple[int, int]:
    """Size of a page, and how many bytes the file is shorter than it says."""
    with file.open("rb") as stream:
        head = stream.read(32)
    page = {1: 65536}.get(stored := int.from_bytes(head[16:18], "big"), stored)
    return page, page * int.from_bytes(head[28:32], "big") - file.stat().st_size


def _rows_of_pages(file: Path, page: int) -> Iterator[tuple[Any, ...]]:
    """Rows of each page that holds some, read in a copy whose table `messages` is that page alone."""
    pages = file.stat().st_size // page if page >= 512 else 0
    left = page * pages
    with TemporaryDirectory(prefix="tactile_bag_") as folder:
        copy = Path(folder) / file.name
        shutil.copyfile(file, copy)
        with copy.open("r+b") as stream:
            stream.truncate(left)
            starts = range(page, left, page)
            leaves = [start for start in starts if stream.seek(start) and stream.read(1) == _LEAF]
            for place, value in ((18, b"\1\1"), (28, pages.to_bytes(4, "big"))):
                stream.seek(place)  # without write-ahead log; of so many pages
                stream.write(value)
        with closing(sqlite3.connect(copy, isolation_level=None)) as database:
            database.execute("PRAGMA writable_schema = ON")
            database.execute("PRAGMA journal_mode = OFF")
            database.execute("DELETE FROM sqlite_master WHERE name != 'messages'")
            for start in leaves:
                try:
                    database.execute("PRAGMA writable_schema = ON")
                    database.execute(_MOVE, (start // page + 1,))
                    database.execute("PRAGMA writable_schema = RESET")  # reads the schema anew
                    for row in database.execute(f"{_MESSAGES} {_SENSIBLE}"):
                        left -= len(row[3])
                        if left < 0:
                            return  # a file that was made for it has rows that share their bytes, endlessly
                        yield row
                except sqlite3.DatabaseError:
                    continue  # this page is damaged, which is told already


def _refuse_computed(database: sqlite3.Connection) -> None:
    """Only what is stored is read: a view or a computed column may have no end."""
    for name in ("topics", "messages", "message_definitions"):
        query = "SELECT type, rootpage FROM sqlite_master WHERE name = ?"
        for kind, page in database.execute(query, (name,)):
            if kind != "table" or not page:
                found = "virtual table" if kind == "table" else kind
                raise sqlite3.DatabaseError(f"{name} must be a table, is a {found}")
        hidden = [row[1] for row in database.execute(f"PRAGMA table_xinfo({name})") if row[6]]
        if hidden:
            raise sqlite3.DatabaseError(f"column {hidden[0]} of {name} is computed, must be stored")


def _read_topics(database: sqlite3.Connection, bag: Bag, faults: list[str]) -> dict[int, tuple[str, str]]:
    topics = {}
    for number, name, type_name in database.execute("SELECT id, name, type FROM topics ORDER BY id"):
        if isinstance(number, int) and isinstance(name, str) and isinstance(type_name, str):
            topics[number] = name, type_name
            bag.add_topic(name, type_name)
        else:
            faults.append(f"topic {number!r:.40} makes no sense: {name!r:.40} of type {type_name!r:.40}")
    return topics


def _read_definitions(database: sqlite3.Connection, bag: Bag, faults: list[str]) -> None:
    """Definitions are in the file since ROS 2 Iron."""
    tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if "message_definitions" not in tables:
        return
    columns = "topic_type, encoded_message_definition"
    rows: Any = database.execute(f"SELECT {columns} FROM message_definitions WHERE encoding = 'ros2msg'")
    for name, text in rows:
        if isinstance(name, str) and isinstance(text, str):
            if text:
                bag.definitions[name] = text
        else:
            faults.append(f"the definition of {name!r:.40} is no text")
