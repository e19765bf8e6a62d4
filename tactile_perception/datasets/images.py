"""Images of a data folder: which file a row means, their size, and reading them whole or not at all."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import cv2
import numpy as np

from tactile_perception.estimating.image import Image, ImageError

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp")
#: What the file of a whole image ends with; a decoder fills what is cut off with gray and says nothing.
_ENDS = {b"\x89PNG": b"IEND\xaeB\x60\x82", b"\xff\xd8\xff": b"\xff\xd9"}
_PROBES = 9


def read_image(path: Path) -> Image:
    """The image, gray.

    Raises
    ------
    ImageError
        If the file cannot be read, is cut short, or is no image.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error}") from error
    for start, end in _ENDS.items():
        if data.startswith(start) and end not in data[-64:]:
            raise ImageError(f"{path}: is not a readable image (truncated, {len(data)} bytes)")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) if data else None
    except cv2.error as error:  # as of a size that no image has
        raise ImageError(f"{path}: is not a readable image: {error.err}") from error
    if image is None:
        raise ImageError(f"{path}: is not a readable image (truncated or of another format)")
    return np.asarray(image, np.uint8)


def list_images(folder: Path) -> set[str]:
    """Names of the image files in a folder."""
    return {path.name for path in folder.iterdir() if path.suffix.lower() in SUFFIXES}


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


def common_shape(image_folder: Path, names: list[str]) -> tuple[int, int] | None:
    """(rows, columns) of more than half of some images spread over the names; None where there is no such."""
    chosen = np.unique(np.linspace(0, len(names) - 1, min(_PROBES, len(names))).round().astype(int))
    shapes: Counter[tuple[int, ...]] = Counter()
    for index in chosen:
        try:
            shapes[read_image(image_folder / names[index]).shape] += 1
        except ImageError:
            continue  # named when it is read as a sample
    if not shapes:
        return None
    (shape, count), *_ = shapes.most_common(1)
    return (shape[0], shape[1]) if count > len(chosen) / 2 else None
