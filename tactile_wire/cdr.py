"""Where the fields of a message are in its bytes, by its definition: for nodes, bags and replay alike.

The encoding is plain CDR, little or big endian, as all ROS 2 middlewares write it. As long as the strings of
a message and the lengths of its sequences stay the same, each of its numbers has a fixed place: a `Layout`
says which, by name. So messages are packed and read without their Python classes, one or thousands at once.
"""

from __future__ import annotations

import functools
import itertools
import operator
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_wire.errors import MessageError
from tactile_wire.message_definitions import type_fields

Array = NDArray[Any]
Number = float | int | bool

HEADER = 4  # bytes of the encapsulation before the body; alignment counts from its end
_BIG, _LITTLE = b"\x00\x00", b"\x00\x01"
_NUMBERS = {"bool": "b1", "byte": "u1", "octet": "u1", "char": "u1", "float32": "f4", "float64": "f8"} | {
    f"{sign}int{8 * size}": f"{'u' if sign else 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)
}
_STRUCT = {"b1": "?", "f4": "f", "f8": "d"} | dict(
    zip(("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8"), "BbHhIiQq", strict=True)
)
_STRING = "string"
_NAME, _BASE, _ARRAY = 2, 1, 3  # rosbags.interfaces.Nodetype
_LARGEST_GAP = 7  # bytes that alignment leaves between two numbers
_REMEMBERED = 64  # layouts of a `MessageReader`
_SHORT = 10_000  # bytes of strings and lengths in a layout that is remembered: all of them stay in memory
LONGEST_TEXT = 1_000_000  # bytes of a string


@dataclass(eq=False)
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
        A message of this layout whose numbers are 0.
    fixed : ndarray
        Indices of the bytes that are the same in all of them: of the strings and the lengths.
    """

    dtype: np.dtype
    texts: dict[str, str]
    lengths: dict[str, int]
    template: bytes
    fixed: Array

    def pack(self, *numbers: Number) -> bytes:
        """The message with these numbers, in the order of its definition: a Header is `sec, nanosec`.

        Raises `ValueError` unless there are `count`.
        """
        if len(numbers) != self.count:
            raise ValueError(f"the message has {self.count} numbers, {len(numbers)} were given")
        out, at = bytearray(self.template), 0
        for part, offset, count in self._runs:
            part.pack_into(out, offset, *numbers[at : at + count])
            at += count
        return bytes(out)

    def unpack(self, data: bytes) -> tuple[Any, ...]:
        """The numbers of a message of this layout, in the order of its definition."""
        return self._all.unpack_from(data)

    def place(self, name: str) -> slice:
        """Where the numbers of a field, nested ones included, are among those of the message."""
        if name not in self._places:
            found = [s for n, s in self._places.items() if n.startswith(f"{name}.")]
            if not found:
                raise KeyError(f"{name}; fields: {', '.join(self.dtype.names or ())}")
            self._places[name] = slice(min(s.start for s in found), max(s.stop for s in found))
        return self._places[name]

    def matches(self, data: bytes) -> bool:
        """Whether a message that is as long as the template has this layout."""
        return bool(self._fixed_of(data) == self._fixed)

    def before(self, name: str) -> Layout:
        """The layout of what stands before the elements of the sequence of numbers that ends a message."""
        dtype: Any = self.dtype
        end = dtype.fields[name][1] if self.lengths[name] else len(self.template)
        kept = [(n, *dtype.fields[n][:2]) for n in dtype.names if dtype.fields[n][1] < end]
        names, formats, offsets = zip(*kept, strict=True)
        cut = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": end})
        return Layout(cut, self.texts, self.lengths, self.template[:end], self.fixed[self.fixed < end])

    @functools.cached_property
    def count(self) -> int:
        """How many numbers the message has, nested ones and elements of arrays included."""
        return sum(count for _, _, count in self._runs)

    @functools.cached_property
    def _runs(self) -> list[tuple[struct.Struct, int, int]]:
        """Numbers between which there is nothing but the gaps of alignment: format, offset, how many."""
        runs: list[tuple[str, int, int]] = []
        end, fixed = -_LARGEST_GAP, set(self.fixed.tolist())
        for dtype, offset in self._numbers():
            size, form = dtype.base.itemsize, dtype.base.str
            count = dtype.itemsize // size
            if offset - end > _LARGEST_GAP or not runs or fixed.intersection(range(end, offset)):
                runs.append((">" if form[0] == ">" else "<", offset, 0))
            before, start, total = runs[-1]
            gap = "x" * (offset - end) if total else ""
            runs[-1] = f"{before}{gap}{count}{_STRUCT[form[1:]]}", start, total + count
            end = offset + dtype.itemsize
        return [(struct.Struct(form), offset, count) for form, offset, count in runs]

    @functools.cached_property
    def _places(self) -> dict[str, slice]:
        counts = [dtype.itemsize // dtype.base.itemsize for dtype, _ in self._numbers()]
        ends = list(itertools.accumulate(counts, initial=0))
        places = map(slice, ends, ends[1:])
        return dict(zip(self.dtype.names or (), places, strict=True))

    @functools.cached_property
    def _all(self) -> struct.Struct:
        """All numbers at once, for reading, which may pass over what lies between them."""
        parts, end = ["<"], 0
        for part, offset, _ in self._runs:
            parts += [f"{offset - end}x", part.format[1:]]
            parts[0], end = part.format[0], offset + part.size
        return struct.Struct("".join(parts))

    @functools.cached_property
    def _fixed_of(self) -> Callable[[bytes], Any]:
        """Picks the bytes that are the same in all messages."""
        cuts = np.flatnonzero(np.diff(self.fixed) != 1) + 1
        return operator.itemgetter(*(slice(int(p[0]), int(p[-1]) + 1) for p in np.split(self.fixed, cuts)))

    @functools.cached_property
    def _fixed(self) -> Any:
        return self._fixed_of(self.template)

    def _numbers(self) -> list[tuple[Any, int]]:
        """Type and offset of each field."""
        fields: Any = self.dtype.fields
        return [fields[name][:2] for name in self.dtype.names or ()]


class MessageReader:
    """Reads messages of one type; it remembers the layouts that it has met.

    Parameters
    ----------
    type_name : str
        `package/msg/Name`, a type whose definition is installed.
    before : str
        Read no more than what stands before this sequence, see `Layout.before`; empty for all.
    """

    def __init__(self, type_name: str, before: str = "") -> None:
        self._type, self._before = type_name, before
        self._fields = type_fields(type_name)
        self._known: dict[int, list[tuple[Layout, Layout]]] = {}

    def __call__(self, data: bytes) -> tuple[Layout, tuple[Any, ...]]:
        """The layout of a message, and its numbers; raises `MessageError`."""
        for layout, read in self._known.get(len(data), ()):
            if layout.matches(data):
                return read, read.unpack(data)
        read = self._remember(data)
        return read, read.unpack(data)

    def _remember(self, data: bytes) -> Layout:
        layout = layout_of(self._fields, self._type, data)
        read = layout.before(self._before) if self._before else layout
        if len(layout.fixed) > _SHORT:
            return read
        if sum(map(len, self._known.values())) >= _REMEMBERED:
            self._known.clear()
        self._known.setdefault(len(data), []).append((layout, read))
        return read


def layout_of(fields: Any, type_name: str, message: bytes) -> Layout:
    """The layout of a message; raises `MessageError` if it is cut or no plain CDR.

    Parameters
    ----------
    fields : mapping
        Type -> (constants, fields), see `message_definitions.type_fields`.
    """
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


def blank_layout(
    type_name: str, texts: Mapping[str, str] | None = None, lengths: Mapping[str, int] | None = None
) -> Layout:
    """The layout, little endian, of messages of an installed type with these strings and lengths.

    Strings that are not named are empty, and so are sequences.
    """
    walk = _Walk(type_fields(type_name), bytearray(_LITTLE + b"\x00\x00"), "<", (texts or {}, lengths or {}))
    walk.message(type_name, "")
    return walk.layout()


@dataclass
class _Walk:
    """Goes through a message field by field; given what `to_write`, strings and lengths, it writes one."""

    fields: Any
    data: Any
    order: str
    to_write: tuple[Mapping[str, str], Mapping[str, int]] | None = None
    at: int = HEADER
    names: list[str] = field(default_factory=list)
    formats: list[Any] = field(default_factory=list)
    offsets: list[int] = field(default_factory=list)
    texts: dict[str, str] = field(default_factory=dict)
    lengths: dict[str, int] = field(default_factory=dict)
    fixed: list[int] = field(default_factory=lambda: [0, 1])

    def layout(self) -> Layout:
        fixed, data = np.array(self.fixed), np.frombuffer(self.data, np.uint8)
        template = np.zeros_like(data)
        template[fixed] = data[fixed]
        parts = {"names": self.names, "formats": self.formats, "offsets": self.offsets}
        dtype = np.dtype({**parts, "itemsize": len(data)})  # type: ignore[call-overload]
        return Layout(dtype, self.texts, self.lengths, template.tobytes(), fixed)

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
            wanted = 0 if self.to_write is None else self.to_write[1].get(name, 0)
            self.lengths[name] = length = self._length(wanted)
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
        if self.to_write is None:
            length = self._length(0)
            if length > LONGEST_TEXT:
                raise MessageError(f"{name} has {length} bytes, must have no more than {LONGEST_TEXT}")
        else:
            encoded = self.to_write[0].get(name, "").encode() + b"\x00"
            length = self._length(len(encoded))
            self.data += encoded
        self.texts[name] = bytes(self.data[self.at : self.at + max(0, length - 1)]).decode()
        self.fixed += range(self.at, self.at + length)
        self.at += length

    def _length(self, wanted: int) -> int:
        """The length of a string or a sequence, which is the same in all messages of the layout."""
        self._align(4)
        if self.to_write is not None:
            self.data += struct.pack(f"{self.order}I", wanted)
        (length,) = struct.unpack_from(f"{self.order}I", self.data, self.at)
        if self.to_write is None and length > len(self.data):
            raise MessageError(f"a length of {length} in {len(self.data)} bytes")
        self.fixed += range(self.at, self.at + 4)
        self.at += 4
        return int(length)

    def _align(self, size: int) -> None:
        self._go(-(self.at - HEADER) % size)

    def _go(self, size: int) -> None:
        self.at += size
        if self.to_write is not None:
            self.data += bytes(size)
