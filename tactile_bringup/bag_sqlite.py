"""Reads the sqlite3 files of `ros2 bag`, damaged and truncated ones as far as sqlite gives rows."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote

from tactile_bringup.bag_contents import Contents, Recorded

_LONGEST_SKIP = 1 << 16  # rows that are passed over at once in search of the next that can be read


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
    missing = _missing_bytes(file)
    try:
        with TemporaryDirectory(prefix="tactile_bag_") as folder:
            path = _whole_pages(file, Path(folder)) if missing else file
            with closing(sqlite3.connect(f"file:{quote(str(path))}?{mode}", uri=True)) as database:
                _read_tables(database, file.name, contents, unpack)
    except sqlite3.DatabaseError as error:
        contents.problems.append(f"{file.name}: {error}")
        return False
    finally:
        if missing:
            contents.problems.append(
                f"{file.name}: the file ends early, at least {missing} bytes are missing"
            )
    return True


def _missing_bytes(file: Path) -> int:
    """How much the file is shorter than its header says."""
    page, pages = _pages(file)
    return max(0, page * pages - file.stat().st_size)


def _pages(file: Path) -> tuple[int, int]:
    """Size of a page and number of pages by the header of a file; 0 for a file that is no database."""
    with file.open("rb") as stream:
        head = stream.read(32)
    if not head.startswith(b"SQLite format 3\0") or len(head) < 32:
        return 0, 0
    size, pages = int.from_bytes(head[16:18], "big"), int.from_bytes(head[28:32], "big")
    return (65536 if size == 1 else size), pages


def _whole_pages(file: Path, folder: Path) -> Path:
    """A copy without the page that the end of the file cuts, of which sqlite would make rows of zeros."""
    page, _ = _pages(file)
    copy = folder / file.name
    whole = file.stat().st_size // page * page
    with file.open("rb") as source, copy.open("wb") as target:
        shutil.copyfileobj(source, target)
        target.truncate(whole)
    return copy


def _read_tables(
    database: sqlite3.Connection, name: str, contents: Contents, unpack: Callable[[bytes], bytes]
) -> None:
    database.execute("PRAGMA writable_schema = ON")  # else a truncated file is refused as a whole
    topics = _read_topics(database, contents)
    _read_definitions(database, contents)
    _read_messages(database, name, topics, contents, unpack)


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


def _read_messages(
    database: sqlite3.Connection,
    name: str,
    topics: dict[int, tuple[str, str]],
    contents: Contents,
    unpack: Callable[[bytes], bytes],
) -> None:
    """All rows in the order of their ids; where some are damaged, those after them as well."""
    kept = {number: contents.wanted(*topic) for number, topic in topics.items()}
    after, skip, told = 0, 1, False
    while skip <= _LONGEST_SKIP:
        query = "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id"
        try:
            for row, number, stamp_ns, data in database.execute(query, (after,)):
                if row <= after:
                    raise sqlite3.DatabaseError("its rows are out of order")
                after, skip = row, 1
                topic, type_name = topics[number]
                contents.counts[topic] += 1
                if kept[number]:
                    contents.messages.append(Recorded(topic, type_name, unpack(data), stamp_ns, stamp_ns))
            return
        except (sqlite3.DatabaseError, KeyError) as error:
            if not told:
                read = f"{contents.read} messages before that were read"
                contents.problems.append(f"{name}: damaged after row {after}: {error}; {read}")
                told = True
            after, skip = after + skip, 2 * skip
