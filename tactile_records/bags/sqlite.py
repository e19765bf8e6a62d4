"""Reads the sqlite3 files of `ros2 bag`; of damaged and truncated ones all rows that are whole."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from tactile_records.bags.contents import Contents, Recorded
from tactile_records.bags.sqlite_pages import rows_of_pages

Row = tuple[int, int, int, bytes]  # id, topic, stamp (ns), data


def read_sqlite(file: Path, contents: Contents, unpack: Callable[[bytes], bytes] = bytes) -> bool:
    """Read one file into `contents`; False if nothing in it can be read.

    Parameters
    ----------
    unpack : callable
        Decompresses one message.
    """
    # A bag whose recorder was killed may have its last rows in a write-ahead log, which only a reader that
    # takes part in the locking sees.
    mode = "mode=ro" if file.with_name(f"{file.name}-wal").exists() else "immutable=1"
    try:
        with closing(sqlite3.connect(f"file:{quote(str(file))}?{mode}", uri=True)) as database:
            database.execute("PRAGMA writable_schema = ON")  # else a truncated file is refused as a whole
            topics = _read_topics(database, contents)
            _read_definitions(database, contents)
            _Messages(file, topics, contents, unpack).read(database)
    except sqlite3.DatabaseError as error:
        contents.problems.append(f"{file.name}: {error}")
        return False
    return True


def _read_topics(database: sqlite3.Connection, contents: Contents) -> dict[int, tuple[str, str]]:
    topics = {}
    for number, name, type_name in database.execute("SELECT id, name, type FROM topics ORDER BY id"):
        topics[number] = name, type_name
        contents.add_topic(name, type_name)
    return topics


def _read_definitions(database: sqlite3.Connection, contents: Contents) -> None:
    """Definitions are in the file since ROS 2 Iron."""
    tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if "message_definitions" not in tables:
        return
    columns = "topic_type, encoded_message_definition"
    rows = database.execute(f"SELECT {columns} FROM message_definitions WHERE encoding = 'ros2msg'")
    contents.definitions.update({name: text for name, text in rows if text})


class _Messages:
    """The messages of one file, in the order of their ids."""

    def __init__(
        self,
        file: Path,
        topics: dict[int, tuple[str, str]],
        contents: Contents,
        unpack: Callable[[bytes], bytes],
    ) -> None:
        self._file, self._topics, self._contents, self._unpack = file, topics, contents, unpack
        self._kept = {number: contents.wanted(*topic) for number, topic in topics.items()}
        self._last = 0

    def read(self, database: sqlite3.Connection) -> None:
        """Ask sqlite as long as it answers, then take what is on whole pages."""
        page_size, missing = _pages(self._file)
        try:
            if missing:  # of a page that the file's end cuts, sqlite would make rows of zeros
                raise sqlite3.DatabaseError(f"the file ends early, {missing} bytes of it are missing")
            self._take(database.execute("SELECT id, topic_id, timestamp, data FROM messages ORDER BY id"))
        except sqlite3.DatabaseError as error:
            whole = [row for row in rows_of_pages(self._file, page_size) if row.id > self._last]
            self._take(row for row in whole if row.topic in self._topics)
            read = f"{self._contents.read} messages of it were read"
            self._contents.problems.append(f"{self._file.name}: damaged: {error}; {read}")

    def _take(self, rows: Iterable[Row]) -> None:
        contents, topics, kept = self._contents, self._topics, self._kept
        for row, number, stamp_ns, data in rows:
            if row <= self._last or number not in topics:
                raise sqlite3.DatabaseError(f"row {row} makes no sense")
            self._last = row
            topic, type_name = topics[number]
            contents.counts[topic] += 1
            if kept[number]:
                contents.messages.append(Recorded(topic, type_name, self._unpack(data), stamp_ns, stamp_ns))


def _pages(file: Path) -> tuple[int, int]:
    """Size of a page, and how many bytes the file is shorter than its header says."""
    with file.open("rb") as stream:
        head = stream.read(32)
    size, pages = int.from_bytes(head[16:18], "big"), int.from_bytes(head[28:32], "big")
    size = 65536 if size == 1 else size
    return size, max(0, size * pages - file.stat().st_size)
