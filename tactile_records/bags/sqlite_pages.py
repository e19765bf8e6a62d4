"""Messages of a damaged sqlite3 bag from its pages alone, where sqlite no longer finds the way to them.

A table is a tree, and a page near its root may lie behind most of its rows: cut off, it leaves sqlite with
none of them. But each leaf page tells its rows by itself. Format: https://www.sqlite.org/fileformat.html
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

LEAF = 0x0D
_LEAF_HEADER = 8
_INTEGER_SIZES = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}
_BLOB = 12


class Row(NamedTuple):
    """A row of the table `messages`."""

    id: int
    topic: int
    stamp_ns: int
    data: bytes


def rows_of_pages(file: Path, page_size: int) -> list[Row]:
    """All rows of `messages` on pages that are whole, by their ids."""
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        pages = _Pages(data, page_size)
        found = {row.id: row for number in range(1, pages.count) for row in pages.rows(number)}
    return [found[number] for number in sorted(found)]


class _Pages:
    def __init__(self, data: mmap.mmap, page_size: int) -> None:
        self._data, self._size = data, page_size
        self._usable = page_size - data[20]  # less what is reserved on each page
        self.count = len(data) // page_size

    def rows(self, number: int) -> Iterator[Row]:
        """The rows of messages on a page, counted from 0; none if it is no leaf of a table."""
        page = self._data[number * self._size : (number + 1) * self._size]
        if page[0] != LEAF:
            return
        (cells,) = struct.unpack_from(">H", page, 3)
        if _LEAF_HEADER + 2 * cells > self._usable:
            return
        for at in struct.unpack_from(f">{cells}H", page, _LEAF_HEADER):
            try:
                row = self._row(page, at)
            except (IndexError, struct.error):
                continue  # a cell that points out of its page
            if row is not None:
                yield row

    def _row(self, page: bytes, at: int) -> Row | None:
        length, at = _varint(page, at)
        row_id, at = _varint(page, at)
        payload = self._payload(page, at, length)
        return None if payload is None else _message(row_id, payload)

    def _payload(self, page: bytes, at: int, length: int) -> bytes | None:
        """The content of a cell, whose end may lie on other pages; None if one of them is missing."""
        largest, least = self._usable - 35, (self._usable - 12) * 32 // 255 - 23
        local = length
        if length > largest:
            local = least + (length - least) % (self._usable - 4)
            local = local if local <= largest else least
        parts, left = [page[at : at + local]], length - local
        following = struct.unpack_from(">I", page, at + local)[0] if left else 0
        while left > 0:
            if not 1 <= following <= self.count:
                return None
            start = (following - 1) * self._size
            (following,) = struct.unpack_from(">I", self._data, start)
            parts.append(self._data[start + 4 : start + 4 + min(left, self._usable - 4)])
            left -= len(parts[-1])
        return b"".join(parts)


def _message(row_id: int, payload: bytes) -> Row | None:
    """A record of messages: id (which is the row's), topic and stamp as integers, data as blob."""
    end, at = _varint(payload, 0)
    kinds = []
    while at < end:
        kind, at = _varint(payload, at)
        kinds.append(kind)
    if len(kinds) != 4 or kinds[0] != 0 or kinds[3] < _BLOB or kinds[3] % 2:
        return None
    topic, at = _integer(payload, end, kinds[1])
    stamp_ns, at = _integer(payload, at, kinds[2])
    data = payload[at : at + (kinds[3] - _BLOB) // 2]
    if topic is None or stamp_ns is None or len(data) != (kinds[3] - _BLOB) // 2:
        return None
    return Row(row_id, topic, stamp_ns, data)


def _integer(payload: bytes, at: int, kind: int) -> tuple[int | None, int]:
    if kind in (8, 9):  # the numbers 0 and 1 take no room
        return kind - 8, at
    size = _INTEGER_SIZES.get(kind)
    if size is None:
        return None, at
    return int.from_bytes(payload[at : at + size], "big", signed=True), at + size


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for _ in range(8):
        byte = data[at]
        value, at = value << 7 | byte & 0x7F, at + 1
        if byte < 0x80:
            return value, at
    return value << 8 | data[at], at + 1
