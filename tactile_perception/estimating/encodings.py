"""Images of what cameras publish, gray or in color: other encodings of pixels, and compressed ones.

Where color is not asked for, it becomes gray as that of a training image in a file does, by its luma
0.299 R + 0.587 G + 0.114 B (ITU-R BT.601); an image in Y'UV has that luma in it. What a model file says
nothing about is refused: how 16 bits become 8, or how a Bayer pattern becomes an image.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_perception.estimating.image import Image, ImageError, decoded

MONO8, BGR8 = "mono8", "bgr8"
_AS_IT_IS = -1
#: Encoding of sensor_msgs/Image -> bytes a pixel, the byte of a pixel that is its luma, and OpenCV's
#: conversion to blue, green and red.
_LUMA = {
    MONO8: (1, 0, cv2.COLOR_GRAY2BGR),
    "8UC1": (1, 0, cv2.COLOR_GRAY2BGR),
    "yuv422_yuy2": (2, 0, cv2.COLOR_YUV2BGR_YUY2),
    "yuv422": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
}
#: The same of encodings without a luma: bytes a pixel, conversions to gray and to blue, green and red.
_COLORS = {
    BGR8: (3, cv2.COLOR_BGR2GRAY, _AS_IT_IS),
    "rgb8": (3, cv2.COLOR_RGB2GRAY, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY, cv2.COLOR_RGBA2BGR),
}
_GRAY = (MONO8, "8UC1")
_HOW = _LUMA | _COLORS
ENCODINGS = tuple(_HOW)
_FILES = ("jpeg", "jpg", "png")
_PNG_DEPTH = 24  # where a PNG file says how many bits a channel has


def pixels_of(
    pixels: NDArray[np.uint8], height: int, width: int, step: int, encoding: str, color: bool = False
) -> Image:
    """The pixels (n,) of an image message as (height, width), or in color (height, width, 3).

    With `color` a message of gray pixels still gives a gray image. Of mono8, and of bgr8 in color, it is a
    view of them.

    Raises
    ------
    ImageError
        If it is of another encoding than `ENCODINGS`, or its numbers contradict each other.
    """
    if encoding not in ENCODINGS:
        raise ImageError(f"encoding is '{encoding}', must be '{MONO8}', or one of {', '.join(ENCODINGS[1:])}")
    if height == 0 or width == 0:
        raise ImageError(f"image is empty: {width}x{height} pixels")
    size, how, to_color = _HOW[encoding]
    if step < width * size:
        rule = "the width" if size == 1 else f"{size} times the width {width},"
        raise ImageError(f"step is {step} bytes, must be at least {rule} {width * size}")
    if len(pixels) != step * height:
        raise ImageError(f"data has {len(pixels)} bytes, must have step * height = {step * height}")
    rows = pixels.reshape(height, step)[:, : width * size]
    if encoding in _GRAY or (encoding in _LUMA and not color):
        return rows[:, how::size]
    cells = rows.reshape(height, width, size)
    if color and to_color == _AS_IT_IS:
        return cells
    return np.asarray(cv2.cvtColor(cells, to_color if color else how), np.uint8)


def encoding_of(image: Image) -> str:
    """Of an image, gray or in color, as it is."""
    return MONO8 if image.ndim == 2 else BGR8


def decompressed(data: bytes | memoryview | NDArray[np.uint8], form: str, color: bool = False) -> Image:
    """The image in a sensor_msgs/CompressedImage, gray or in color; `form` is its `format`.

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
    return decoded(data, f"'{form}'", color)
