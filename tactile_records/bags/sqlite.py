"""Reads the sqlite3 files of `ros2 bag`; of damaged and truncated ones the rows that sqlite still finds."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote

from tactile_records.bags.contents import Bag, Recorded

Row = tuple[int, int, int, bytes]  # id, topic, stamp (ns), data


def read_sqlite(file: Path, bag: Bag, unpack: Callable[[bytes], bytes] = bytes) -> bool:
    """Read one file into `bag`; False if nothing in it can be read.

    Parameters
    ----------
    unpack : callable
        Decompresses one message.
    """
    missing, size = _missing(file)
    if not missing:
        return _read(file, bag, unpack, [])
    # Of a page that the end of the file cuts sqlite would make messages that end in zeros: leave it out.
    with TemporaryDirectory(prefix="tactile_bag_") as folder:
        whole = Path(folder) / file.name
        shutil.copyfile(file, whole)
        with whole.open("r+b") as stream:
            stream.truncate(size)
        return _read(whole, bag, unpack, [f"the file ends early, {missing} bytes of it are missing"])


def _missing(file: Path) -> tuple[int, int]:
    """How many bytes the file is shorter than its header says, and the size of its whole pages."""
    with file.open("rb") as stream:
        head = stream.read(32)
    page, pages, size = (
        int.from_bytes(head[16:18], "big"),
        int.from_bytes(head[28:32], "big"),
        file.stat().st_size,
    )
    page = 65536 if page == 1 else max(page, 1)
    return max(0, page * pages - size), size // page * page


def _read(file: Path, bag: Bag, unpack: Callable[[bytes], bytes], faults: list[str]) -> bool:
    # A bag whose recorder was killed may have its last rows in a write-ahead log, which only a reader that
    # takes part in the locking sees.
    mode = "mode=ro" if file.with_name(f"{file.name}-wal").exists() else "immutable=1"
    before = bag.read
    try:
        with closing(sqlite3.connect(f"file:{quote(str(file))}?{mode}", uri=True)) as database:
            database.execute("PRAGMA writable_schema = ON")  # else a truncated file is refused as a whole
            topics = _read_topics(database, bag)
            _read_definitions(database, bag)
            kept = {number: bag.wanted(*topic) for number, topic in topics.items()}
            for _, number, stamp_ns, data in _rows(database, file.stat().st_size, topics.keys(), faults):
                topic, type_name = topics[number]
                bag.counts[topic] += 1
                if kept[number]:
                    message = Recorded(topic, type_name, unpack(data), stamp_ns, stamp_ns)
                    bag.messages.append(message)
    except sqlite3.DatabaseError as error:
        bag.problems.append(f"{file.name}: {'; '.join([*faults, str(error)])}")
        return False
    if faults:
        read = bag.read - before
        found = f"{read} messages of it were read, `sqlite3 {file.name} .recover` may find more"
        bag.problems.append(f"{file.name}: damaged: {'; '.join(dict.fromkeys(faults))}; {found}")
        return read > 0
    return True


def _rows(
    database: sqlite3.Connection, size: int, topics: Collection[int], faults: list[str]
) -> Iterator[Row]:
    """The messages by their ids; behind a damaged page those that sqlite finds when asked for later ids."""
    query = "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id"
    last, step = 0, 1
    while last < size:  # there are fewer rows than bytes
        try:
            for row in database.execute(query, (last,)):
                if row[0] <= last or row[1] not in topics:
                    raise sqlite3.DatabaseError(f"row {row[0]} makes no sense")
                last, step = row[0], 1
                yield row
            return
        except sqlite3.DatabaseError as error:
            faults.append(str(error))
            last, step = last + step, step + step // 4 + 1


def _read_topics(database: sqlite3.Connection, bag: Bag) -> dict[int, tuple[str, str]]:
    topics = {}
    for number, name, type_name in database.execute("SELECT id, name, type FROM topics ORDER BY id"):
        topics[number] = name, type_name
        bag.add_topic(name, type_name)
    return topics


def _read_definitions(database: sqlite3.Connection, bag: Bag) -> None:
    """Definitions are in the file since ROS 2 Iron."""
    tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if "message_definitions" not in tables:
        return
    columns = "topic_type, encoded_message_definition"
    rows = database.execute(f"SELECT {columns} FROM message_definitions WHERE encoding = 'ros2msg'")
    bag.definitions.update({name: text for name, text in rows if text})
