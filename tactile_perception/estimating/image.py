"""Tactile images in memory and in files: what is one, the error for what is none, and reading them whole.

An image is uint8: gray (rows, columns), or (rows, columns, 3) of blue, green and red where that is asked for.
"""

from __future__ import annotations

import base64
import os
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_base.exposures import DamagedJpeg, pixels_of_jpeg
from tactile_base.input_file import check_regular

Image = NDArray[np.uint8]
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp")
_JPEG, _PNG = b"\xff\xd8\xff", b"\x89PNG"
#: What a whole PNG ends with; a decoder fills what is cut off with gray and says nothing.
_PNG_END = b"IEND\xaeB\x60\x82"
_PROBES = 9


class ImageError(ValueError):
    """An image of the wrong size, type or number of channels."""


def check_image(image: object, shape: tuple[int, int] | None, what: str, color: bool = False) -> Image:
    """`image` if it is uint8 of this (rows, columns), None: of any; else `ImageError` says what it is."""
    if not isinstance(image, np.ndarray):
        raise ImageError(f"{what}: must be a NumPy array, is {type(image).__name__}")
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.ndim != 2 + color or image.size == 0 or (color and image.shape[2] != 3):
        kind = "a color image (bgr8)" if color else "a gray image (mono8)"
        size = "" if shape is None else f" of {shape[1]}x{shape[0]}"
        raise ImageError(f"{what}: must be {kind}{size}, has the shape {image.shape}")
    if image.dtype != np.uint8:
        raise ImageError(f"{what}: must be 8-bit (uint8), is {image.dtype}")
    if shape is not None and image.shape[:2] != shape:
        raise ImageError(
            f"{what}: must be {shape[1]}x{shape[0]} pixels, is {image.shape[1]}x{image.shape[0]}"
        )
    return image


def gray(image: Image) -> Image:
    """The luma of an image in color, 0.299 R + 0.587 G + 0.114 B; a gray one as it is."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def in_color(image: Image) -> Image:
    """With three channels, which are equal where it is gray."""
    return image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)


def read_image(path: Path, color: bool = False) -> Image:
    """The image, gray or in color; `ImageError` if the file cannot be read, is cut short, or is no image."""
    try:
        check_regular(path)
        data = path.read_bytes()
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error}") from error
    return decoded(data, str(path), color)


def decoded(data: bytes, what: str, color: bool = False) -> Image:
    """The image in the bytes of a file; `ImageError` if it is cut short, damaged, or is no image.

    A gray one where color is asked for gets three channels that are equal.
    """
    if data.startswith(_JPEG):
        try:
            return pixels_of_jpeg(data, color)
        except DamagedJpeg as error:
            raise ImageError(f"{what}: is not a readable image: {error}") from error
    if data.startswith(_PNG) and _PNG_END not in data[-64:]:
        raise ImageError(f"{what}: is not a readable image (truncated, {len(data)} bytes)")
    how = cv2.IMREAD_COLOR if color else cv2.IMREAD_GRAYSCALE
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), how) if data else None
    except cv2.error as error:  # as of a size that no image has
        raise ImageError(f"{what}: is not a readable image: {error.err}") from error
    if image is None:
        raise ImageError(f"{what}: is not a readable image (truncated or of another format)")
    return np.asarray(image, np.uint8)


def packed(image: Image) -> str:
    """As text for a model's metadata: a PNG in base64."""
    done, data = cv2.imencode(".png", image)
    assert done
    return base64.b64encode(data.tobytes()).decode()


def unpacked(text: str, what: str, color: bool = False) -> Image:
    """The reverse; `ValueError` if it is not in base64, `ImageError` if it is no image."""
    return decoded(base64.b64decode(text, validate=True), what, color)


def list_images(folder: Path) -> set[str]:
    """Names of the image files in a folder."""
    with os.scandir(folder) as entries:
        return {entry.name for entry in entries if entry.name.lower().endswith(SUFFIXES) and entry.is_file()}


def resolve(image_folder: Path, name: str, present: set[str]) -> str | None:
    """The file that a row means, relative to the image folder; None if it is not there.

    Tables name a file of the folder, with or without a path before it, or one elsewhere by a path from there.
    """
    plain = Path(name.replace("\\", "/")).name
    if plain == name:
        return name if name in present else None
    if (image_folder / name).is_file():
        return name
    return plain if plain in present else None


class ImageKind(NamedTuple):
    """What some images have in common: (rows, columns), nothing but 0 and 255, how many channels."""

    shape: tuple[int, int]
    binary: bool
    channels: int


def handful(image_folder: Path, names: list[str], kind: ImageKind | None) -> list[Image]:
    """Some images spread over the names, of the `common_kind` that most have: in color, or gray."""
    found: list[Image] = []
    if kind is None:
        return found
    for name in _spread(names):
        try:
            image = read_image(image_folder / name, kind.channels >= 3)
        except ImageError:
            continue
        if image.shape[:2] == kind.shape:
            found.append(image)
    return found


def _spread(names: list[str]) -> list[str]:
    chosen = np.unique(np.linspace(0, len(names) - 1, min(_PROBES, len(names))).round().astype(int))
    return [names[index] for index in chosen]


def common_kind(image_folder: Path, names: list[str]) -> ImageKind | None:
    """What more than half of some images spread over the names are; None where there is no such."""
    chosen = _spread(names)
    kinds: Counter[ImageKind] = Counter()
    for name in chosen:
        path = image_folder / name
        try:
            image = read_image(path)
        except ImageError:
            continue  # named when it is read as a sample
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        channels = 1 if stored is None or stored.ndim == 2 else stored.shape[2]
        binary = bool(np.isin(image, (0, 255)).all() and image.min() < image.max())
        kinds[ImageKind((image.shape[0], image.shape[1]), binary, channels)] += 1
    if not kinds:
        return None
    (kind, count), *_ = kinds.most_common(1)
    return kind if count > len(chosen) / 2 else None
