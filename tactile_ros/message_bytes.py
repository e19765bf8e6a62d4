"""Messages as the bytes that travel, for those that a node sends or takes at the rate of the camera.

Why by bytes: see `tactile_wire.packing`. An image is copied once each way, where the message classes make
three copies: 1 ms of 3.5 for 640x480.
"""

from __future__ import annotations

import functools
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from numpy.typing import ArrayLike, NDArray
from rclpy.serialization import serialize_message

from tactile_base.stamps import SECOND_NS
from tactile_msgs.msg import ContactForce, ContactState
from tactile_perception.estimating.encodings import decompressed
from tactile_perception.estimating.image import ImageError
from tactile_ros.conversions import checked_image
from tactile_wire import cdr, packing
from tactile_wire.cdr import Number
from tactile_wire.errors import MessageError
from tactile_wire.message_definitions import type_fields
from tactile_wire.packing import FRAME

Array = NDArray[np.float64]

_HEADER_END = cdr.HEADER + 12  # where the frame's name begins: after its stamp and its length
LONGEST_NAME = 200  # characters of what people and nodes call themselves and their goals
STAMP_NUMBERS = 2  # sec and nanosec, which a message with a header starts with


class Layout(cdr.Layout):
    """Where the numbers of a message are, as long as its strings and lengths are those of an example.

    Parameters
    ----------
    example : message
        Its numbers do not matter.
    """

    def __init__(self, example: Any) -> None:
        name = type_name(type(example))
        found = cdr.layout_of(type_fields(name), name, serialize_message(example))
        vars(self).update(vars(cdr.blank_layout(name, found.texts, found.lengths)))


class HeadedReader:
    """Reads messages that start with a header, and whose numbers alone are of interest."""

    def __init__(self, message_type: Any) -> None:
        self._name = type_name(message_type)
        self._reader = cdr.MessageReader(self._name)

    def __call__(self, data: bytes) -> tuple[int, str, tuple[Any, ...]]:
        """Stamp (ns), frame, and the numbers behind the header; raises `MessageError` for cut bytes."""
        layout, numbers = self._reader(data)
        return numbers[0] * SECOND_NS + numbers[1], layout.texts[FRAME], numbers[STAMP_NUMBERS:]

    def place(self, name: str) -> slice:
        """Where a field is among the numbers behind the header, of a type without sequences before it."""
        found = cdr.blank_layout(self._name).place(name)
        return slice(found.start - STAMP_NUMBERS, found.stop - STAMP_NUMBERS)


def header_of(data: bytes) -> tuple[int, str]:
    """Stamp (ns) and frame of any message that starts with a header; raises `MessageError`."""
    order = {b"\x00\x00": ">", b"\x00\x01": "<"}.get(bytes(data[:2]))
    if order is None or len(data) < _HEADER_END:
        raise MessageError(f"{len(data)} bytes that start with 0x{bytes(data[:2]).hex()} are no plain CDR")
    sec, nanosec, length = struct.unpack_from(f"{order}iII", data, cdr.HEADER)
    if length > len(data) - _HEADER_END:
        raise MessageError(f"a frame's name of {length} bytes in a message of {len(data)}")
    try:
        frame = bytes(data[_HEADER_END : _HEADER_END + max(0, length - 1)]).decode()
    except UnicodeDecodeError as error:
        raise MessageError(f"the frame's name is not UTF-8: {error}") from error
    return sec * SECOND_NS + nanosec, frame


@dataclass(frozen=True)
class ReceivedTransform:
    """One transform of a TFMessage; `translation` x y z in m, `rotation` x y z w."""

    stamp_ns: int
    parent: str
    child: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]


def transforms_from_bytes(data: bytes) -> list[ReceivedTransform]:
    """The transforms of a serialized TFMessage; raises `MessageError` for cut bytes."""
    layout, numbers = _read_transforms(data)
    found = []
    for parent, child, place in _frames(layout):
        sec, nanosec, x, y, z, *q = numbers[place]
        found.append(ReceivedTransform(sec * SECOND_NS + nanosec, parent, child, (x, y, z), (*q,)))
    return found


@functools.lru_cache(maxsize=64)
def _frames(layout: cdr.Layout) -> list[tuple[str, str, slice]]:
    """Parent and child of each transform, and where its numbers are."""
    names = [f"transforms.{index}" for index in range(layout.lengths["transforms"])]
    texts = layout.texts
    return [(texts[f"{n}.{FRAME}"], texts[f"{n}.child_frame_id"], layout.place(n)) for n in names]


@dataclass(frozen=True)
class ReceivedImage:
    """An Image message whose content has not been checked yet; `pixels` shares the memory of its bytes."""

    stamp_ns: int
    height: int
    width: int
    encoding: str
    step: int
    pixels: NDArray[np.uint8]

    def array(self, color: bool = False) -> NDArray[np.uint8]:
        """The image, gray or in color; raises `MessageError` as `conversions.array_from_image`."""
        return checked_image(self.pixels, self.height, self.width, self.step, self.encoding, color)


@dataclass(frozen=True)
class ReceivedCompressed:
    """A CompressedImage message whose content has not been looked at yet."""

    stamp_ns: int
    form: str
    data: memoryview

    def array(self, color: bool = False) -> NDArray[np.uint8]:
        """The image, gray or in color; raises `MessageError` as `encodings.decompressed` would."""
        try:
            return decompressed(self.data, self.form, color)
        except ImageError as error:
            raise MessageError(str(error)) from error


def compressed_from_bytes(data: bytes) -> ReceivedCompressed:
    """The fields of a serialized CompressedImage; raises `MessageError` for cut bytes.

    No two are of one length: nothing is gained by remembering layouts.
    """
    head = cdr.layout_of(type_fields(COMPRESSED), COMPRESSED, data).before(PIXELS)
    sec, nanosec = head.unpack(data)
    start = len(head.template)
    file = memoryview(data)[start : start + head.lengths[PIXELS]]
    return ReceivedCompressed(sec * SECOND_NS + nanosec, head.texts["format"], file)


def image_from_bytes(data: bytes) -> ReceivedImage:
    """The fields of a serialized Image; raises `MessageError` for cut bytes."""
    layout, (sec, nanosec, height, width, _, step) = _read_head(data)
    pixels = np.frombuffer(data, np.uint8, layout.lengths[PIXELS], len(layout.template))
    stamp_ns, encoding = sec * SECOND_NS + nanosec, layout.texts["encoding"]
    return ReceivedImage(stamp_ns, height, width, encoding, step, pixels)


def headed_bytes(message_type: Any, stamp_ns: int, frame_id: str, *numbers: Number, **texts: str) -> bytes:
    """As `packing.headed_bytes`, of a message class."""
    return packing.headed_bytes(type_name(message_type), stamp_ns, frame_id, *numbers, **texts)


@dataclass(frozen=True)
class ReceivedCommand:
    """An ArmCommand; its twist (6,) may be NaN: that is for the safe command stage to refuse."""

    stamp_ns: int
    frame_id: str
    source: str
    session: int
    sequence: int
    twist: Array


def command_from_bytes(data: bytes) -> ReceivedCommand:
    """A serialized ArmCommand; `MessageError` for cut bytes."""
    layout, (sec, nanosec, session, sequence, *twist) = _read_command(data)
    stamp_ns, texts = sec * SECOND_NS + nanosec, layout.texts
    if len(texts["source"]) > LONGEST_NAME:
        raise MessageError(f"its source has {len(texts['source'])} characters, at most {LONGEST_NAME} may be")
    return ReceivedCommand(stamp_ns, texts[FRAME], texts["source"], session, sequence, np.array(twist))


def twist_bytes(stamp_ns: int, frame_id: str, twist: ArrayLike) -> bytes:
    """TwistStamped of [v, omega] (6,) in `frame_id`."""
    return headed_bytes(TwistStamped, stamp_ns, frame_id, *np.asarray(twist, dtype=np.float64).tolist())


def type_name(message_type: Any) -> str:
    """`package/msg/Name` of a message class."""
    return f"{message_type.__module__.split('.')[0]}/msg/{message_type.__name__}"


_read_transforms = cdr.MessageReader("tf2_msgs/msg/TFMessage")

read_gaussian = HeadedReader(PoseWithCovarianceStamped)
"""Stamp (ns), frame and numbers; `pose_numbers.gaussian_from_numbers` checks these and makes a Gaussian."""

_read_command = cdr.MessageReader("tactile_msgs/msg/ArmCommand")
IMAGE, PIXELS = "sensor_msgs/msg/Image", "data"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
_read_head = cdr.MessageReader(IMAGE, before=PIXELS)

read_state = HeadedReader(ContactState)
"""Stamp (ns), frame and numbers; xi and flags among them are at `STATE_XI` and `STATE_FLAGS`."""
STATE_XI, STATE_FLAGS = read_state.place("xi"), read_state.place("flags").start

read_force = HeadedReader(ContactForce)
"""Stamp (ns), frame and numbers: the force, its covariance, row by row, and the NIS."""


def force_from_bytes(data: bytes) -> tuple[int, Array]:
    """Stamp and force (3,) of a serialized ContactForce; `MessageError` for one that is not finite."""
    stamp_ns, _, numbers = read_force(data)
    force = np.array(numbers[:3])
    if not np.isfinite(force).all():
        raise MessageError("its force is not finite")
    return stamp_ns, force
