"""Reads the sqlite3 files of `ros2 bag`; of damaged and truncated ones the rows that sqlite still finds."""

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
from tactile_records.bags.sqlite_pages import Row, page_size, stray_rows
from tactile_records.bags.unpacking import MESSAGE_COST, TooLarge, Unpacker


def read_sqlite(file: Path, bag: Bag, unpacker: Unpacker) -> bool:
    """Read one file into `bag`, as far as `unpacker` allows; False if nothing in it can be read."""
    missing, size = _missing(file)
    if not missing:
        return _read(file, bag, unpacker, [])
    # Of a page that the end of the file cuts sqlite would make messages that end in zeros: leave it out.
    with TemporaryDirectory(prefix="tactile_bag_") as folder:
        whole = Path(folder) / file.name
        shutil.copyfile(file, whole)
        with whole.open("r+b") as stream:
            stream.truncate(size)
        return _read(whole, bag, unpacker, [f"the file ends early, {missing} bytes of it are missing"])


def _missing(file: Path) -> tuple[int, int]:
    """How many bytes the file is shorter than its header says, and the size of its whole pages."""
    with file.open("rb") as stream:
        head = stream.read(32)
    page, pages, size = max(page_size(head), 1), int.from_bytes(head[28:32], "big"), file.stat().st_size
    return max(0, page * pages - size), size // page * page


def _read(file: Path, bag: Bag, unpacker: Unpacker, faults: list[str]) -> bool:
    # A bag whose recorder was killed may have its last rows in a write-ahead log, which only a reader that
    # takes part in the locking sees.
    mode = "mode=ro" if file.with_name(f"{file.name}-wal").exists() else "immutable=1"
    before = bag.read
    try:
        with closing(sqlite3.connect(f"file:{quote(str(file))}?{mode}", uri=True)) as database:
            database.execute("PRAGMA writable_schema = ON")  # else a truncated file is refused as a whole
            _refuse_computed(database)
            topics = _read_topics(database, bag, faults)
            _read_definitions(database, bag, faults)
            kept = {number: bag.wanted(*topic) for number, topic in topics.items()}
            rows = _rows(database, file.stat().st_size, topics.keys(), faults)
            if faults:  # the end of the file is missing, and with it perhaps what finds the messages
                rows = _rows_or_strays(rows, file, topics.keys(), faults)
            for _, number, stamp_ns, data in rows:
                topic, type_name = topics[number]
                bag.counts[topic] += 1
                if kept[number]:
                    unpacker.take(len(data) + MESSAGE_COST)
                    bag.messages.append(Recorded(topic, type_name, data, stamp_ns, stamp_ns))
    except TooLarge as error:
        faults.append(str(error))
    except sqlite3.DatabaseError as error:
        bag.problems.append(f"{file.name}: {'; '.join([*faults, str(error)])}")
        return False
    if faults:
        read = bag.read - before
        found = f"{read} messages of it were read, `sqlite3 {file.name} .recover` may find more"
        bag.problems.append(f"{file.name}: damaged: {'; '.join(dict.fromkeys(faults))}; {found}")
        return read > 0
    return True


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


def _rows(
    database: sqlite3.Connection, size: int, topics: Collection[int], faults: list[str]
) -> Iterator[Row]:
    """The messages by their ids; behind a damaged page those that sqlite finds when asked for later ids."""
    query = "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id"
    last, step, senseless = 0, 1, []
    while last < size:  # there are fewer rows than bytes
        try:
            for row in database.execute(query, (last,)):
                number, topic, stamp_ns, data = row
                if isinstance(number, int):
                    if number <= last:
                        raise sqlite3.DatabaseError(f"row {number} comes after row {last}")
                    last, step = number, 1
                types = type(number), type(stamp_ns), type(data)
                if topic in topics and types == (int, int, bytes):
                    yield row
                else:
                    senseless.append(number)
            break
        except sqlite3.DatabaseError as error:
            faults.append(str(error))
            last, step = last + step, step + step // 4 + 1
    if senseless:
        faults.append(
            f"{len(senseless)} rows of messages make no sense, the first with id {senseless[0]!r:.40}"
        )


def _rows_or_strays(
    rows: Iterator[Row], file: Path, topics: Collection[int], faults: list[str]
) -> Iterator[Row]:
    """The rows; where there is none, those that stand in the file nevertheless."""
    if (first := next(rows, None)) is not None:
        yield first
        yield from rows
        return
    last = 0
    for row in stray_rows(file):
        if row[0] > last and row[1] in topics:  # of a page that was given up there may be older ones
            last = row[0]
            yield row
    if last:
        faults.append("the page by which messages are found is missing")


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
