"""Messages straight from the pages of an sqlite3 file that hold them, where the pages above are lost.

A large file has the page by which its messages are found in its middle; where the end of the file is missing,
so may that page be, and sqlite finds no message then. Layouts are those of sqlite's "Database File Format": a
leaf of a table starts with type 13 and the number of its cells, whose offsets stand from byte 8 on; a cell is
the length of a record, the row's number and the record, the rest of which follows on further pages.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from pathlib import Path

Row = tuple[int, int, int, bytes]  # id, topic, stamp (ns), data

_LEAF = 13
_INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}  # bytes of an integer by its type
_COLUMNS, _SHORTEST = 4, 8  # of a message; bytes of a cell, at least


def page_size(head: bytes) -> int:
    """Bytes of a page, by the first 18 or more of a file."""
    size = int.from_bytes(head[16:18], "big")
    return 65536 if size == 1 else size


def stray_rows(file: Path) -> Iterator[Row]:
    """All rows that look like messages, in the order of pages; those that are not whole are left out."""
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        size = page_size(data[:18])
        if size < 512:
            return
        usable, left = size - data[20], len(data)
        for at in _cells(data, size):
            length, at = _varint(data, at)
            left -= max(length, _SHORTEST)
            if left < 0:
                return  # a file that was made for it holds records that share their bytes, without end
            number, at = _varint(data, at)
            row = _row(number, _record(data, at, length, size, usable), length)
            if row is not None:
                yield row


def _cells(data: mmap.mmap, size: int) -> Iterator[int]:
    """Where the cells of all leaves stand."""
    for start in range(size, len(data) - size + 1, size):  # the first page is the schema's
        if data[start] == _LEAF:
            count = int.from_bytes(data[start + 3 : start + 5], "big")
            for place in range(start + 8, start + 8 + 2 * count, 2):
                yield start + int.from_bytes(data[place : place + 2], "big")


def _row(number: int, record: bytes, length: int) -> Row | None:
    """The row of a record that should have that length; None if it is no message, or not all of it."""
    head, at = _varint(record, 0)
    types: list[int] = []
    while at < head and len(types) <= _COLUMNS:
        kind, at = _varint(record, at)
        types.append(kind)
    if len(record) != length or at != head or len(types) != _COLUMNS or types[0] != 0:
        return None  # the id of a row stands before its record, where it is NULL
    topic, at = _integer(record, head, types[1])
    stamp_ns, at = _integer(record, at, types[2])
    blob = record[at:]
    if topic is None or stamp_ns is None or types[3] != 12 + 2 * len(blob):
        return None
    return number, topic, stamp_ns, blob


def _record(data: mmap.mmap, at: int, length: int, size: int, usable: int) -> bytes:
    """A record of which a part stands here and the rest on pages of its own, as much as there is."""
    local, least = length, (usable - 12) * 32 // 255 - 23
    if length > usable - 35:
        local = least + (length - least) % (usable - 4)
        local = local if local <= usable - 35 else least
    parts, left, at = [data[at : at + local]], length - local, at + local
    while left > 0:
        start = (int.from_bytes(data[at : at + 4], "big") - 1) * size
        if not 0 < start <= len(data) - size:
            break
        parts.append(data[start + 4 : start + min(usable, 4 + left)])
        left, at = left - (usable - 4), start
    return b"".join(parts)


def _integer(record: bytes, at: int, kind: int) -> tuple[int | None, int]:
    if kind in (8, 9):  # the numbers 0 and 1
        return kind - 8, at
    count = _INTEGERS.get(kind)
    if count is None:
        return None, at
    return int.from_bytes(record[at : at + count], "big", signed=True), at + count


def _varint(data: mmap.mmap | bytes, at: int) -> tuple[int, int]:
    """An integer of up to nine bytes, and where it ends; 0 where the data end."""
    value = 0
    for byte in data[at : at + 8]:
        at += 1
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at
    return value << 8 | int.from_bytes(data[at : at + 1], "big"), at + 1
