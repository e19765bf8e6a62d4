"""Messages as the bytes that travel, for those that a node sends or takes at the rate of the camera.

Python's message classes cost 0.1 to 0.3 ms a message, once to build it and once to convert it, and more on a
core that has just woken up. Where the strings of a message stay the same, each of its numbers has a fixed
place: a `Layout` packs all of them at once. The encoding is plain CDR, little endian, which ROS 2 middlewares
write on today's machines; bytes that look otherwise go through the message class, with the same answer.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from rclpy.serialization import deserialize_message
from tf2_msgs.msg import TFMessage

from tactile_base.stamps import SECOND_NS

PLAIN_CDR_LE = b"\x00\x01"
BODY = 4  # where the body starts, behind the encapsulation header; alignment counts from there

_FORMATS = {
    "boolean": "?",
    "octet": "B",
    "uint8": "B",
    "int8": "b",
    "uint16": "H",
    "int16": "h",
    "uint32": "I",
    "int32": "i",
    "uint64": "Q",
    "int64": "q",
    "float": "f",
    "double": "d",
}

Number = float | int | bool


class Layout:
    """Where the numbers of a message are in its bytes, as long as its strings and lengths stay the same.

    Parameters
    ----------
    example : message
        A message with those strings and lengths; its numbers do not matter.

    Attributes
    ----------
    count : int
        How many numbers the message has, nested ones included, in the order of the definition: a Header is
        `sec, nanosec`, an array its elements.
    """

    def __init__(self, example: Any) -> None:
        builder = _Builder()
        builder.message(example)
        self._parts = builder.parts()
        self._bytes = bytes(builder.bytes)
        self.count = sum(count for _, _, count in self._parts)

    def pack(self, *numbers: Number) -> bytes:
        """The serialized message with these numbers; raises `ValueError` unless there are `count`."""
        if len(numbers) != self.count:
            raise ValueError(f"the message has {self.count} numbers, {len(numbers)} were given")
        out, at = bytearray(self._bytes), 0
        for part, offset, count in self._parts:
            part.pack_into(out, offset, *numbers[at : at + count])
            at += count
        return bytes(out)

    def unpack(self, data: bytes) -> tuple[Number, ...]:
        """The numbers of a message that has the strings and lengths of the example."""
        if len(self._parts) == 1:
            part, offset, _ = self._parts[0]
            return part.unpack_from(data, offset)
        return sum((part.unpack_from(data, offset) for part, offset, _ in self._parts), ())


class HeadedReader:
    """Reads messages whose only string is their header's frame."""

    def __init__(self, message_type: Any) -> None:
        self._type = message_type
        self._layouts: dict[int, Layout] = {}

    def __call__(self, data: bytes) -> tuple[int, str, tuple[Number, ...]]:
        """Stamp (ns), frame, and the numbers behind the header; raises `struct.error` for cut bytes."""
        if data[:2] != PLAIN_CDR_LE:
            message = deserialize_message(data, self._type)
            return _headed(message.header.frame_id, tuple(numbers_of(message)))
        (length,) = struct.unpack_from("<I", data, BODY + 8)
        layout = self._layouts.get(length)
        if layout is None:
            layout = self._layouts[length] = self._layout(length)
        return _headed(data[BODY + 12 : BODY + 11 + length].decode(), layout.unpack(data))

    def _layout(self, length: int) -> Layout:
        example = self._type()
        example.header.frame_id = "x" * max(0, length - 1)
        return Layout(example)


@dataclass(frozen=True)
class ReceivedTransform:
    """One transform of a TFMessage; `translation` x y z in m, `rotation` x y z w."""

    stamp_ns: int
    parent: str
    child: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]


def transforms_from_bytes(data: bytes) -> list[ReceivedTransform]:
    """The transforms of a serialized TFMessage."""
    if data[:2] != PLAIN_CDR_LE:
        return [_transform(transform) for transform in deserialize_message(data, TFMessage).transforms]
    (count,) = struct.unpack_from("<I", data, BODY)
    found, at = [], BODY + 4
    for _ in range(count):
        at = aligned(at, 4)
        sec, nanosec = struct.unpack_from("<iI", data, at)
        parent, at = read_text(data, at + 8)
        child, at = read_text(data, aligned(at, 4))
        at = aligned(at, 8)
        x, y, z, *rotation = struct.unpack_from("<7d", data, at)
        at += 56
        found.append(ReceivedTransform(sec * SECOND_NS + nanosec, parent, child, (x, y, z), tuple(rotation)))
    return found


def split_stamp(stamp_ns: int) -> tuple[int, int]:
    """Seconds and nanoseconds of a stamp; negative ones become zero, which ROS reads as 'none'."""
    return divmod(max(int(stamp_ns), 0), SECOND_NS)


def numbers_of(message: Any) -> Iterator[Number]:
    """All numbers of a message, nested ones included, in the order of its definition."""
    for name, kind in message.get_fields_and_field_types().items():
        yield from _numbers(getattr(message, name), kind)


@functools.cache
def parse_kind(kind: str) -> tuple[str, bool]:
    """Element type of a field's type, and whether a length stands before its elements."""
    if kind.startswith("sequence<"):
        return kind.removeprefix("sequence<").removesuffix(">").split(",")[0].strip(), True
    return kind.split("[")[0], False


def read_text(data: bytes, at: int) -> tuple[str, int]:
    """A string, and where it ends."""
    (length,) = struct.unpack_from("<I", data, at)
    end = at + 4 + length
    return data[at + 4 : end - 1].decode(), end


def aligned(at: int, size: int) -> int:
    """The next place for something of this size (bytes)."""
    return at + (BODY - at) % size


class _Builder:
    """Lays out an example: its bytes with zeros for the numbers, and the runs of numbers between strings."""

    def __init__(self) -> None:
        self.bytes = bytearray(PLAIN_CDR_LE + b"\x00\x00")
        self._runs: list[tuple[int, str, int]] = [(BODY, "<", 0)]  # offset, format, count

    def parts(self) -> list[tuple[struct.Struct, int, int]]:
        return [(struct.Struct(form), offset, count) for offset, form, count in self._runs if count]

    def message(self, message: Any) -> None:
        for name, kind in message.get_fields_and_field_types().items():
            value = getattr(message, name)
            element, counted = parse_kind(kind)
            if counted:
                self._length(len(value))
            _each(value, kind, functools.partial(self._element, element))

    def _element(self, kind: str, value: Any) -> None:
        if kind in _FORMATS:
            self._number(_FORMATS[kind])
        elif kind.startswith("string"):
            encoded = value.encode() + b"\x00"
            self._length(len(encoded))
            self.bytes += encoded
            self._runs.append((len(self.bytes), "<", 0))
        else:
            self.message(value)

    def _number(self, form: str) -> None:
        offset, total, count = self._runs[-1]
        gap = self._align(struct.calcsize(form))
        self.bytes += bytes(struct.calcsize(form))
        self._runs[-1] = offset, f"{total}{'x' * gap}{form}", count + 1

    def _length(self, length: int) -> None:
        """A number that the layout fixes."""
        self._align(4)
        self.bytes += struct.pack("<I", length)
        self._runs.append((len(self.bytes), "<", 0))

    def _align(self, size: int) -> int:
        gap = aligned(len(self.bytes), size) - len(self.bytes)
        self.bytes += bytes(gap)
        return gap


def _each(value: Any, kind: str, visit: Callable[[Any], None]) -> None:
    """Call `visit` with the value, or with each of its elements where the type is an array or a sequence."""
    if "[" in kind or kind.startswith("sequence<"):
        for element in value:
            visit(element)
    else:
        visit(value)


def _numbers(value: Any, kind: str) -> Iterator[Number]:
    elements: list[Any] = []
    _each(value, kind, elements.append)
    element, _ = parse_kind(kind)
    for part in elements:
        if element in _FORMATS:
            yield part
        elif not element.startswith("string"):
            yield from numbers_of(part)


def _headed(frame_id: str, numbers: tuple[Number, ...]) -> tuple[int, str, tuple[Number, ...]]:
    return int(numbers[0]) * SECOND_NS + int(numbers[1]), frame_id, numbers[2:]


def _transform(message: Any) -> ReceivedTransform:
    stamp, t, r = message.header.stamp, message.transform.translation, message.transform.rotation
    stamp_ns = int(stamp.sec) * SECOND_NS + int(stamp.nanosec)
    return ReceivedTransform(
        stamp_ns, message.header.frame_id, message.child_frame_id, (t.x, t.y, t.z), (r.x, r.y, r.z, r.w)
    )
