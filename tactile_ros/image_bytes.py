"""sensor_msgs/Image as the bytes that travel: one copy each way, where Python's message classes make three.

From camera to estimator that saves 1 ms of 3.5 for an image of 640x480 (bench/ros_latency.py); see `cdr`.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import ns_from_parts
from tactile_records.bags.cdr import Layout, MessageReader, blank_layout
from tactile_ros.cdr import split_stamp
from tactile_ros.conversions import MONO8, MessageError, checked_image

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class ReceivedImage:
    """An Image message whose content has not been checked yet; `pixels` shares the memory of its bytes."""

    stamp_ns: int
    height: int
    width: int
    encoding: str
    step: int
    pixels: Image

    def array(self) -> Image:
        """Gray image (height, width) uint8; raises `MessageError` as `conversions.array_from_image`."""
        return checked_image(self.pixels, self.height, self.width, self.step, self.encoding)


def bytes_from_array(stamp_ns: int, frame_id: str, image: Image) -> bytes:
    """Serialized Image, mono8, of a gray image (height, width) uint8."""
    if image.ndim != 2 or image.dtype != np.uint8:
        raise MessageError(f"image: must be uint8 (height, width), is {image.dtype} {image.shape}")
    height, width = image.shape
    head = _head(frame_id, image.size).pack(*split_stamp(stamp_ns), height, width, 0, width)
    return b"".join((head, np.ascontiguousarray(image).data))


def image_from_bytes(data: bytes) -> ReceivedImage:
    """The fields of a serialized Image; raises `MessageError` for cut bytes."""
    layout, (sec, nanosec, height, width, _, step) = _read_head(data)
    pixels = np.frombuffer(data, np.uint8, layout.lengths[PIXELS], len(layout.template))
    stamp_ns, encoding = ns_from_parts(sec, nanosec), layout.texts["encoding"]
    return ReceivedImage(stamp_ns, height, width, encoding, step, pixels)


@functools.lru_cache(maxsize=16)
def _head(frame_id: str, size: int) -> Layout:
    """What stands before the pixels."""
    texts = {"header.frame_id": frame_id, "encoding": MONO8}
    return blank_layout(IMAGE, texts, {PIXELS: size}).before(PIXELS)


IMAGE, PIXELS = "sensor_msgs/msg/Image", "data"
_read_head = MessageReader(IMAGE, before=PIXELS)
