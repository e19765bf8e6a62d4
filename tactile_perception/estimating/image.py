"""What a tactile image is in memory, and the error for what is none."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


class ImageError(ValueError):
    """An image of the wrong size, type or number of channels."""


def check_image(image: object, shape: tuple[int, int] | None, what: str) -> Image:
    """`image` if it is uint8 of this (rows, columns), None: of any; else `ImageError` says what it is."""
    if not isinstance(image, np.ndarray):
        raise ImageError(f"{what}: must be a NumPy array, is {type(image).__name__}")
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.ndim != 2 or image.size == 0:
        size = "" if shape is None else f" of {shape[1]}x{shape[0]}"
        raise ImageError(f"{what}: must be a gray image (mono8){size}, has the shape {image.shape}")
    if image.dtype != np.uint8:
        raise ImageError(f"{what}: must be 8-bit (mono8, uint8), is {image.dtype}")
    if shape is not None and image.shape != shape:
        raise ImageError(
            f"{what}: must be {shape[1]}x{shape[0]} pixels, is {image.shape[1]}x{image.shape[0]}"
        )
    return image
