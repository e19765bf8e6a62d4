"""Many messages of one type at once, as NumPy arrays: one column for each number of the message.

All messages of one layout together are one structured array over their bytes. A recording has few layouts for
a topic. Definitions are those that the bag brings, so that other versions of a type are read as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_wire.cdr import Layout, layout_of
from tactile_wire.errors import MessageError

Array = NDArray[Any]

_MOST_LAYOUTS = 1000


@dataclass
class Columns:
    """The messages of one layout: their indices (N,), and their numbers as structured array (N,)."""

    indices: Array
    values: Array
    layout: Layout

    def stack(self, names: Sequence[str]) -> Array:
        """These columns as float64 (N, len(names))."""
        return np.stack([self.values[name] for name in names], axis=1).astype(np.float64)

    def stamps_ns(self, name: str = "header.stamp") -> Array:
        """A Time as int64 nanoseconds (N,)."""
        return stamps_ns(self.values, name)


Needed = Mapping[str, tuple[int, ...] | None]  # name -> shape of its numbers, None for a text


def lacking(layout: Layout, needed: Needed) -> str:
    """The first of these fields that messages of a layout do not have; empty where they have all."""
    fields: Any = layout.dtype.fields or {}
    for name, shape in needed.items():
        has = name in layout.texts if shape is None else name in fields and fields[name][0].shape == shape
        if not has:
            return name
    return ""


def stamps_ns(values: Array, name: str) -> Array:
    """The Time of this name in a structured array, as int64 nanoseconds (N,)."""
    seconds = values[f"{name}.sec"].astype(np.int64)
    return seconds * SECOND_NS + values[f"{name}.nanosec"].astype(np.int64)


def pose_columns(position: str, orientation: str) -> tuple[str, ...]:
    """The columns of a pose's seven numbers: position, quaternion (x, y, z, w)."""
    return (*(f"{position}.{axis}" for axis in "xyz"), *(f"{orientation}.{axis}" for axis in "xyzw"))


class ColumnReader:
    """Reads messages of one type.

    Parameters
    ----------
    fields : mapping
        Type -> (constants, fields), as `rosbags.typesys` has them: `typestore.fielddefs`.
    needed : mapping, optional
        Fields without which a message is of no use.
    """

    def __init__(self, fields: Any, type_name: str, needed: Needed | None = None) -> None:
        self._fields, self._type, self._needed = fields, type_name, needed or {}
        self.unreadable: list[tuple[int, str]] = []  # index and reason

    def read(self, messages: Sequence[bytes]) -> list[Columns]:
        """The messages by layout; those that are no message of the type are left in `unreadable`."""
        self.unreadable = []
        by_length: dict[int, list[int]] = {}
        for index, data in enumerate(messages):
            by_length.setdefault(len(data), []).append(index)
        groups: list[Columns] = []
        for length, indices in by_length.items():
            rows = np.array(indices)
            raw = np.frombuffer(b"".join(messages[i] for i in indices), np.uint8).reshape(len(rows), length)
            while len(rows):
                try:
                    layout = self._layout(messages[rows[0]], len(groups))
                except MessageError as error:
                    self.unreadable.append((int(rows[0]), str(error)))
                    rows, raw = rows[1:], raw[1:]
                    continue
                template = np.frombuffer(layout.template, np.uint8)
                same = (raw[:, layout.fixed] == template[layout.fixed]).all(axis=1)
                groups.append(
                    Columns(
                        rows[same], np.ascontiguousarray(raw[same]).reshape(-1).view(layout.dtype), layout
                    )
                )
                rows, raw = rows[~same], raw[~same]
        return groups

    def _layout(self, message: bytes, known: int) -> Layout:
        if known >= _MOST_LAYOUTS:
            raise MessageError(f"{self._type}: has another layout than {known} others")
        layout = layout_of(self._fields, self._type, message)
        if missing := lacking(layout, self._needed):
            raise MessageError(f"{self._type}: has no field {missing} of its kind")
        return layout


def rows_of(array: Array) -> Iterator[bytes]:
    """The bytes of each row of a structured array."""
    size, data = array.dtype.itemsize, array.tobytes()
    return (data[start : start + size] for start in range(0, len(data), size))
