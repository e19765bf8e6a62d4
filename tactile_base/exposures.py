"""What makes a frame no exposure, whoever looks at it: it repeats an earlier one, shows nothing, is damaged.

A camera's driver refuses such frames before they are published, and perception those that come from drivers
and nodes of others: both by the same functions, in the same words.
"""

from __future__ import annotations

import re
from collections import deque

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
REMEMBERED = 600  # frames, by which a recording is known that is played again and again
#: What is said of some cameras' frames, which pad their segments, though nothing is missing.
_PADDING, _MOST_PADDING = re.compile(r"(\d+) extraneous bytes before marker"), 8
_MOST_PIXELS = 2**26
_JPEG_END = b"\xff\xd9"


class DamagedJpeg(ValueError):
    """A JPEG of which a part is missing or makes no sense."""


class Exposures:
    """Remembers frames, to know them again: no two exposures of a camera are equal in every bit."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """The next frame is the first."""
        self._last: Pixels = np.empty(0, np.uint8)
        self._order: deque[int] = deque()
        self._known: set[int] = set()

    def repeats(self, frame: Pixels) -> str:
        """Why a frame is no new exposure; empty if it is one, and is remembered then.

        Frames are known by a hash of every 16th row; of the last one a copy says whether all of it is equal.
        """
        mark = hash((frame.shape, frame[::16].tobytes()))
        if mark in self._known:
            if mark != self._order[-1]:
                return f"repeated: it equals one of the last {len(self._order)}, bit for bit: a recording?"
            if np.array_equal(self._last, frame):
                return "repeated: it equals the one before it bit for bit: the camera is frozen"
            self._order.pop()
        if self._last.shape == frame.shape:  # a driver's buffer is used again; JPEGs differ in size
            np.copyto(self._last, frame)
        else:
            self._last = frame.copy()
        self._known.add(mark)
        self._order.append(mark)
        if len(self._order) > REMEMBERED:
            self._known.remove(self._order.popleft())
        return ""


def objection(image: Pixels, least_contrast: float) -> str:
    """Why an image shows nothing; empty where its gray levels, or those of one color, vary by enough."""
    mean, deviation = cv2.meanStdDev(np.ascontiguousarray(image[::4, ::4]))
    contrast = float(deviation.max())
    if contrast >= least_contrast:
        return ""
    return (
        f"without contrast: gray levels of {mean[0, 0]:.0f} vary by {contrast:.1f}, must by "
        f"{least_contrast:g}: is the lamp on, the lens free?"
    )


def pixels_of_jpeg(data: bytes | memoryview | Pixels, color: bool = False) -> Pixels:
    """The luma (rows, columns) or the colors (rows, columns, 3) of a JPEG that is whole.

    A camera's may lack its Huffman tables.

    A decoder fills what it cannot read with gray, or with what it takes for the image, and goes on: a packet
    that is lost on the bus leaves a picture of which a part has moved. It knows, and says so here. Up to
    eight bytes too many between two segments are what some cameras pad with.

    Raises `DamagedJpeg` if it is cut, is no JPEG, or its data do not make the whole image and nothing else.
    """
    data = np.frombuffer(data, np.uint8) if not isinstance(data, np.ndarray) else data.ravel()
    # padded with zeros by some devices
    if _JPEG_END not in data[-4096:].tobytes().rstrip(b"\0")[-64:]:
        raise DamagedJpeg(f"a JPEG of {data.size} bytes without its end")
    data = np.ascontiguousarray(data)
    try:
        height, width, *_ = simplejpeg.decode_jpeg_header(data, strict=False)
    except (ValueError, KeyError) as error:  # KeyError: of a kind of pixels that there is not
        raise DamagedJpeg(f"{data.size} bytes that are no JPEG: {error}") from error
    if height * width > _MOST_PIXELS:
        raise DamagedJpeg(f"{data.size} bytes that claim to be {width}x{height} pixels")
    image = np.empty((height, width, 3 if color else 1), np.uint8)
    try:
        simplejpeg.decode_jpeg(data, "BGR" if color else "GRAY", buffer=image)
    except ValueError as error:
        padding = _PADDING.search(str(error))
        if padding is None or int(padding[1]) > _MOST_PADDING:
            raise DamagedJpeg(f"a JPEG of {data.size} bytes with damage inside: {error}") from error
    return image if color else image[:, :, 0]
