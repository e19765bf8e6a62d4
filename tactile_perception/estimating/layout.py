"""How the images of a sensor lie in its camera: the mean of those that a network was trained on.

Markers are where they are because of how camera and tip are mounted. A camera that is mirrored or turned
shows them elsewhere, and a network then takes left for right. In the mean of many contacts the markers are
blurred, but stand where the sensor has them; the image without contact fits that mean better than any
mirrored or turned form of it (on simulated and on real sensors; docs/perception.md), also of one that is
turned by a few degrees, as of a camera that has come loose.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_perception.estimating.image import Image, ImageError, gray, packed, unpacked
from tactile_perception.estimating.preprocessing import PreprocessingSettings, brightness

Array = NDArray[np.float64]
#: By how much another form has to fit better, as a correlation, to be what the camera shows.
MARGIN = 0.05
#: Degrees by which a camera may have turned and is still where it was, and up to which a turn is looked for.
_LEAST, _MOST, _STEP = 3.0, 20.0, 0.5


class LayoutError(ValueError):
    """A layout that cannot be read."""


@dataclass(frozen=True)
class Layout:
    """Mean of a network's training images.

    Attributes
    ----------
    mean : uint8 (size, size)
        As the network's input, gray.
    """

    mean: Image

    @classmethod
    def of(cls, images: ArrayLike) -> Layout:
        """Of prepared images (N, size, size), uint8 or in gray levels, or uint8 (N, size, size, 3)."""
        total = np.zeros(np.shape(images)[1:3])
        for image in np.asarray(images):
            total += gray(image)
        return cls(np.rint(total / len(np.asarray(images))).astype(np.uint8))

    def to_text(self) -> str:
        """As text for a model's metadata."""
        return packed(self.mean)

    @classmethod
    def from_text(cls, text: str, size: int) -> Layout:
        """The reverse; `LayoutError` unless it is an image (size, size)."""
        try:
            mean = unpacked(text, "layout")
        except (ImageError, ValueError) as error:
            raise LayoutError(f"layout: is no image in base64: {error}") from error
        if mean.shape != (size, size):
            raise LayoutError(f"layout: has the shape {mean.shape}, must be ({size}, {size})")
        return cls(mean)

    def objection(self, prepared: ArrayLike, settings: PreprocessingSettings) -> str:
        """Which other form of the mean fits an image without contact clearly better; empty: none.

        `prepared` is the network's input (size, size) or (1, channels, size, size).
        """
        image = np.asarray(brightness(np.asarray(prepared)), float)
        own = _likeness(image, self.mean)
        other, name = max((_likeness(image, form), name) for name, form in self._forms(settings))
        if other <= own + MARGIN:
            return ""
        return (
            f"the picture is {name}: as such it fits what the model was trained on by {other:.2f}, as it "
            f"is by {own:.2f}"
        )

    def _forms(self, settings: PreprocessingSettings) -> Iterator[tuple[str, NDArray]]:
        """What the mean would be, were the whole of the camera's image mirrored or turned, or its crop alone.

        The crop need not lie in the middle of the image: then what is shown of the turned image is shifted.
        """
        x0, y0, x1, y1 = settings.bbox
        off = np.array([x0 + x1 - settings.raw_width, y0 + y1 - settings.raw_height]) / 2.0
        scale = len(self.mean) / np.array([x1 - x0, y1 - y0])
        for mirrored, quarters in itertools.product((False, True), range(4)):
            if not mirrored and not quarters:
                continue
            turn = np.rint(_turn(mirrored, quarters))
            name = " and ".join(filter(None, ("mirrored" if mirrored else "", _turned(quarters))))
            for center in (off, np.zeros(2)):
                # about the image's middle, seen from that of the crop: p -> turn (p + off) - off
                shift = scale * (turn @ center - center)
                yield name, _moved(self.mean, turn, shift)
        for degrees in np.arange(_LEAST, _MOST + _STEP, _STEP):
            for sense, name in ((1.0, "clockwise"), (-1.0, "counter-clockwise")):
                turn = _rotation(sense * np.deg2rad(degrees))
                yield f"turned {name} by {degrees:g} degrees", _moved(self.mean, turn, np.zeros(2))


def _turned(quarters: int) -> str:
    return f"turned clockwise by {90 * quarters} degrees" if quarters else ""


def _turn(mirrored: bool, quarters: int) -> Array:
    """(2, 2) of columns and rows: a mirror of the columns, then quarter turns."""
    return _rotation(np.pi / 2 * quarters) @ np.diag([-1.0 if mirrored else 1.0, 1.0])


def _rotation(angle: float) -> Array:
    """Of columns and rows, which is clockwise on a screen."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _moved(image: Image, turn: Array, shift: Array) -> Image:
    """The image turned about its middle, then shifted by pixels (columns, rows)."""
    middle = (np.array(image.shape[::-1]) - 1) / 2
    matrix = np.hstack([turn, (middle - turn @ middle + shift)[:, None]])
    return np.asarray(cv2.warpAffine(image, matrix, image.shape[::-1], flags=cv2.INTER_LINEAR), np.uint8)


def _likeness(image: NDArray, other: NDArray) -> float:
    """Correlation of two images, -1 to 1; 0 for one that is even."""
    a, b = (part.astype(float) - part.mean() for part in (image, other))
    length = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float((a * b).sum()) / length if length else 0.0
