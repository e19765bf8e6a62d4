"""What makes a frame no exposure, whoever looks at it: it repeats an earlier one, shows nothing, is damaged.

A camera's driver refuses such frames before they are published, and perception those that come from drivers
and nodes of others: both by the same functions, in the same words.
"""

from __future__ import annotations

import re
from collections import deque

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
        self._last: Pixels | None = None
        self._order: deque[int] = deque()
        self._known: set[int] = set()

    def repeats(self, frame: Pixels) -> str:
        """Why a frame is no new exposure; empty if it is one.

        Of the last one a copy is kept, since buffers are used again; of `REMEMBERED` before it a hash of
        every fourth row.
        """
        if self._last is None or self._last.shape != frame.shape:  # JPEGs differ in size
            self._last = frame.copy()
        elif np.array_equal(self._last, frame):
            return "repeated: it equals the one before it bit for bit: the camera is frozen"
        else:
            np.copyto(self._last, frame)
        mark = hash((frame.shape, frame[::4].tobytes()))
        if mark in self._known:
            return f"repeated: it equals one of the last {len(self._order)} bit for bit: is it a recording?"
        self._known.add(mark)
        self._order.append(mark)
        if len(self._order) > REMEMBERED:
            self._known.remove(self._order.popleft())
        return ""


def objection(image: Pixels, least_contrast: float) -> str:
    """Why a gray image (rows, columns) shows nothing; empty where its gray levels vary by enough."""
    sample = image[::4, ::4]
    contrast = float(sample.std())
    if contrast >= least_contrast:
        return ""
    return (
        f"without contrast: gray levels of {sample.mean():.0f} vary by {contrast:.1f}, must by "
        f"{least_contrast:g}: is the lamp on, the lens free?"
    )


def gray_of_jpeg(data: bytes | memoryview | Pixels) -> Pixels:
    """The luma (rows, columns) of a JPEG that is whole; a camera's may lack its Huffman tables.

    A decoder fills what it cannot read with gray, or with what it takes for the image, and goes on: a packet
    that is lost on the bus leaves a picture of which a part has moved. It knows, and says so here. Up to
    eight bytes too many between two segments are what some cameras pad with.

    Raises
    ------
    DamagedJpeg
        If it is cut, is no JPEG, or its data do not make the whole image and nothing else.
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
    image = np.empty((height, width, 1), np.uint8)
    try:
        simplejpeg.decode_jpeg(data, "GRAY", buffer=image)
    except ValueError as error:
        padding = _PADDING.search(str(error))
        if padding is None or int(padding[1]) > _MOST_PADDING:
            raise DamagedJpeg(f"a JPEG of {data.size} bytes with damage inside: {error}") from error
    return image[:, :, 0]
