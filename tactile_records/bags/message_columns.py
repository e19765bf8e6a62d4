"""Many CDR messages of one type at once, as NumPy arrays: one column for each number of the message.

Messages with the same strings and the same lengths of sequences have each number in the same place, so that
all of them together are one structured array over their bytes. A recording has few such layouts for a topic.
Definitions are those that the bag brings, so that other versions of a type are read as well.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

HEADER = 4  # bytes of the encapsulation before the body; alignment counts from its end
_BIG, _LITTLE = b"\x00\x00", b"\x00\x01"
_NUMBERS = {"bool": "?", "byte": "u1", "octet": "u1", "char": "u1", "float32": "f4", "float64": "f8"} | {
    f"{sign}int{8 * size}": f"{'u' if sign else 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)
}
_STRING = "string"
_NAME, _BASE, _ARRAY = 2, 1, 3  # rosbags.interfaces.Nodetype


class MessageError(ValueError):
    """Bytes that are no message of their type; the text says why."""


@dataclass
class Layout:
    """Where the numbers of a message are.

    Attributes
    ----------
    dtype : np.dtype
        Structured type over all bytes of a message; fields are named `pose.position.x`, `parts.0.stamp.sec`.
    texts : dict
        Name -> string; the same in all messages of this layout.
    lengths : dict
        Name -> number of elements of each sequence.
    template : bytes
        A message of this layout.
    fixed : ndarray
        Indices of the bytes that are the same in all of them: of the strings and the lengths.
    """

    dtype: np.dtype
    texts: dict[str, str]
    lengths: dict[str, int]
    template: bytes
    fixed: Array


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


def stamps_ns(values: Array, name: str) -> Array:
    """The Time of this name in a structured array, as int64 nanoseconds (N,)."""
    seconds = values[f"{name}.sec"].astype(np.int64)
    return seconds * 1_000_000_000 + values[f"{name}.nanosec"].astype(np.int64)


class ColumnReader:
    """Reads messages of one type.

    Parameters
    ----------
    fields : mapping
        Type -> (constants, fields), as `rosbags.typesys` has them: `typestore.fielddefs`.
    """

    def __init__(self, fields: Any, type_name: str) -> None:
        self._fields, self._type = fields, type_name
        self.unreadable: list[tuple[int, str]] = []  # index and reason

    def read(self, messages: Sequence[bytes]) -> list[Columns]:
        """The messages by layout; those that are no message of the type are left in `unreadable`."""
        self.unreadable = []
        by_length: dict[int, list[int]] = {}
        for index, data in enumerate(messages):
            by_length.setdefault(len(data), []).append(index)
        groups = []
        for length, indices in by_length.items():
            rows = np.array(indices)
            raw = np.frombuffer(b"".join(messages[i] for i in indices), np.uint8).reshape(len(rows), length)
            while len(rows):
                try:
                    layout = layout_of(self._fields, self._type, messages[rows[0]])
                except MessageError as error:
                    self.unreadable.append((int(rows[0]), str(error)))
                    rows, raw = rows[1:], raw[1:]
                    continue
                template = np.frombuffer(layout.template, np.uint8)
                same = (raw[:, layout.fixed] == template[layout.fixed]).all(axis=1)
                groups.append(Columns(rows[same], _structured(raw[same], layout.dtype), layout))
                rows, raw = rows[~same], raw[~same]
        return groups


def _structured(raw: Array, dtype: np.dtype) -> Array:
    return np.ascontiguousarray(raw).reshape(-1).view(dtype)


def layout_of(fields: Any, type_name: str, message: bytes) -> Layout:
    """The layout of a message; raises `MessageError` if it is cut or no plain CDR."""
    if bytes(message[:2]) not in (_LITTLE, _BIG):
        raise MessageError(f"{type_name}: encapsulation 0x{bytes(message[:2]).hex()} is no plain CDR")
    walk = _Walk(fields, message, ">" if bytes(message[:2]) == _BIG else "<")
    try:
        walk.message(type_name, "")
    except KeyError as error:
        raise MessageError(f"{type_name}: its definition lacks {error}") from error
    except (struct.error, UnicodeDecodeError, MessageError) as error:
        raise MessageError(f"{type_name}: {len(message)} bytes are no such message: {error}") from error
    if walk.at > len(message):
        raise MessageError(f"{type_name}: cut, has {len(message)} bytes and needs {walk.at}")
    return walk.layout()


def blank_layout(fields: Any, type_name: str, texts: dict[str, str]) -> Layout:
    """The layout, little endian, of messages with these strings (all others are empty) and no sequences."""
    walk = _Walk(fields, bytearray(_LITTLE + b"\x00\x00"), "<", texts)
    walk.message(type_name, "")
    return walk.layout()


@dataclass
class _Walk:
    """Goes through a message field by field; given `texts` it writes one instead."""

    fields: Any
    data: Any
    order: str
    texts_to_write: dict[str, str] | None = None
    at: int = HEADER
    names: list[str] = field(default_factory=list)
    formats: list[Any] = field(default_factory=list)
    offsets: list[int] = field(default_factory=list)
    texts: dict[str, str] = field(default_factory=dict)
    lengths: dict[str, int] = field(default_factory=dict)
    fixed: list[int] = field(default_factory=lambda: [0, 1])

    def layout(self) -> Layout:
        template = bytes(self.data)
        parts = {"names": self.names, "formats": self.formats, "offsets": self.offsets}
        dtype = np.dtype({**parts, "itemsize": len(template)})  # type: ignore[call-overload]
        return Layout(dtype, self.texts, self.lengths, template, np.array(self.fixed))

    def message(self, type_name: str, prefix: str) -> None:
        for name, kind in self.fields[type_name][1]:
            self._field(f"{prefix}{name}", kind)

    def _field(self, name: str, kind: Any) -> None:
        node, content = kind
        if node == _BASE:
            self._base(name, content[0], ())
        elif node == _NAME:
            self.message(content, f"{name}.")
        elif node == _ARRAY:
            self._elements(name, content[0], content[1])
        else:
            self.lengths[name] = length = self._count()
            self._elements(name, content[0], length)

    def _elements(self, name: str, kind: Any, count: int) -> None:
        node, content = kind
        if node == _BASE and content[0] in _NUMBERS:
            if count:
                self._base(name, content[0], (count,))
            return
        for index in range(count):
            self._field(f"{name}.{index}", kind)
            if self.at > len(self.data):
                raise MessageError(f"{name}: {count} elements do not fit into {len(self.data)} bytes")

    def _base(self, name: str, kind: str, shape: tuple[int, ...]) -> None:
        if kind in _NUMBERS:
            dtype = np.dtype(f"{self.order}{_NUMBERS[kind]}")
            self._align(dtype.itemsize)
            self.names.append(name)
            self.formats.append((dtype, shape) if shape else dtype)
            self.offsets.append(self.at)
            self._go(dtype.itemsize * (shape[0] if shape else 1))
        elif kind == _STRING:
            self._string(name)
        else:
            raise MessageError(f"{name}: fields of type {kind} are not supported")

    def _string(self, name: str) -> None:
        if self.texts_to_write is None:
            length = self._count()
            self.texts[name] = bytes(self.data[self.at : self.at + max(0, length - 1)]).decode()
        else:
            self.texts[name] = text = self.texts_to_write.get(name, "")
            encoded = text.encode() + b"\x00"
            length = len(encoded)
            self._align(4)
            self.data += struct.pack("<I", length) + encoded
            self.at += 4
        self.fixed += range(self.at, self.at + length)
        self.at += length

    def _count(self) -> int:
        """The length of a string or a sequence, which is the same in all messages of the layout."""
        self._align(4)
        if self.texts_to_write is not None:
            self._go(4)
            return 0
        (count,) = struct.unpack_from(f"{self.order}I", self.data, self.at)
        if count > len(self.data):
            raise MessageError(f"a length of {count} in {len(self.data)} bytes")
        self.fixed += range(self.at, self.at + 4)
        self.at += 4
        return int(count)

    def _align(self, size: int) -> None:
        self._go(-(self.at - HEADER) % size)

    def _go(self, size: int) -> None:
        self.at += size
        if self.texts_to_write is not None:
            self.data += bytes(size)


def rows_of(array: Array) -> Iterator[bytes]:
    """The bytes of each row of a structured array."""
    size, data = array.dtype.itemsize, array.tobytes()
    return (data[start : start + size] for start in range(0, len(data), size))
