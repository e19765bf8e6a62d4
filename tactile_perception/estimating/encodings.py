"""Gray images of what cameras publish: other encodings of pixels, and images that are compressed.

A color becomes gray as that of a training image in a file does, by its luma 0.299 R + 0.587 G + 0.114 B
(ITU-R BT.601); an image in Y'UV has that luma in it. What a model file says nothing about is refused: how 16
bits become 8, or how a Bayer pattern becomes an image.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_perception.estimating.image import Image, ImageError, decoded

MONO8 = "mono8"
#: Encoding of sensor_msgs/Image -> bytes a pixel, and what makes it gray: nothing, the byte of a pixel that
#: is its luma, or OpenCV's conversion.
_LUMA = {MONO8: (1, 0), "8UC1": (1, 0), "yuv422_yuy2": (2, 0), "yuv422": (2, 1)}
_COLORS = {
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
}
ENCODINGS = (*_LUMA, *_COLORS)
_FILES = ("jpeg", "jpg", "png")
_PNG_DEPTH = 24  # where a PNG file says how many bits a channel has


def gray_of(pixels: NDArray[np.uint8], height: int, width: int, step: int, encoding: str) -> Image:
    """The pixels (n,) of an image message as (height, width); of mono8 a view of them.

    Raises
    ------
    ImageError
        If it is of another encoding than `ENCODINGS`, or its numbers contradict each other.
    """
    if encoding not in ENCODINGS:
        raise ImageError(f"encoding is '{encoding}', must be '{MONO8}', or one of {', '.join(ENCODINGS[1:])}")
    if height == 0 or width == 0:
        raise ImageError(f"image is empty: {width}x{height} pixels")
    size, how = (_LUMA | _COLORS)[encoding]
    if step < width * size:
        rule = "the width" if size == 1 else f"{size} times the width {width},"
        raise ImageError(f"step is {step} bytes, must be at least {rule} {width * size}")
    if len(pixels) != step * height:
        raise ImageError(f"data has {len(pixels)} bytes, must have step * height = {step * height}")
    rows = pixels.reshape(height, step)[:, : width * size]
    if encoding in _LUMA:
        return rows[:, how::size]
    return np.asarray(cv2.cvtColor(rows.reshape(height, width, size), how), np.uint8)


def decompressed(data: bytes | memoryview | NDArray[np.uint8], form: str) -> Image:
    """The gray image in a sensor_msgs/CompressedImage; `form` is its `format`.

    image_transport writes "ENCODING; jpeg compressed bgr8" or "ENCODING; png compressed ...", others "jpeg".

    Raises
    ------
    ImageError
        If the format is another one, or the data is no whole image of it.
    """
    encoding, _, rest = form.partition(";")
    file = (rest or encoding).strip().partition(" ")[0]
    if file not in _FILES or (rest and encoding not in ENCODINGS):
        right = f"'jpeg' or 'png', or '{MONO8}; png' with one of {', '.join(ENCODINGS)}"
        raise ImageError(f"format is '{form}', must be {right}")
    data = bytes(data)
    if data.startswith(b"\x89PNG") and data[_PNG_DEPTH : _PNG_DEPTH + 1] != b"\x08":
        raise ImageError(f"'{form}' is a PNG of {data[_PNG_DEPTH]} bits, must have 8")
    return decoded(data, f"'{form}'")
