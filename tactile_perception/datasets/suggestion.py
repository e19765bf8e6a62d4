"""Which pre-processing suits a sensor's images: found out from a handful of them, for a person to confirm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_perception.estimating.image import Image, ImageError, gray
from tactile_perception.estimating.preprocessing import NO_THRESHOLD, PreprocessingSettings
from tactile_perception.markers.detection import detect

_COLORFUL = 8.0  # gray levels by which the colors of a picture differ, where it is gray but for compression
_LIT = 0.12  # of the brightest parts: what is darker, and never changes, is not the sensor's skin
_FEWEST_MARKERS, _STEADY = 20, 0.1
_BLOCK = 2.7  # spacings of markers: the side of the threshold's neighborhood, as in the published data
_ROUND = 0.06  # by which the area of a view may differ from that of a disk as wide
_GLARE, _FEW = 2.0, 2e-4  # times as bright as markers; part of the pixels
_GAIN = 3.0  # of a difference: contacts change a picture by a fraction of its range


@dataclass(frozen=True)
class Suggestion:
    """Settings, and why each was chosen."""

    settings: PreprocessingSettings
    reasons: tuple[str, ...]


def suggested(images: Sequence[Image], reference: bool = False) -> Suggestion:
    """Look at camera images of different contacts, all of one size, gray or in color.

    `reference`: there is an image without contact, with which others can be compared.

    Raises `ImageError` for fewer than three images, or of several sizes.
    """
    shapes = {image.shape for image in images}
    if len(images) < 3 or len(shapes) > 1:
        raise ImageError(f"{len(images)} images of the sizes {shapes}: needs three or more of one size")
    color, colored = _colored(images)
    grays = [gray(image) for image in images]
    seen = _of_markers(grays)
    if isinstance(seen, str):
        why = f"{seen}; levels are taken as they are"
        found: dict[str, object] = {"threshold_method": NO_THRESHOLD, "median": 0, "color": color}
        crop, circle, view = _view(_lit(grays))
        if reference:
            found["difference"] = _GAIN
            why += ", and compared with the image without contact"
    else:
        found, inside, why = seen
        crop, circle, view = _view(inside)
    rows, columns = grays[0].shape
    settings = PreprocessingSettings().replaced(
        raw_width=columns, raw_height=rows, bbox=crop, circle_mask_radius=circle, **found
    )
    return Suggestion(settings, (colored, why, view))


def _colored(images: Sequence[Image]) -> tuple[bool, str]:
    """Whether colors differ where it is not dark, and that in words."""
    if images[0].ndim == 2:
        return False, "images are gray"
    stack = np.stack([cv2.resize(image, (64, 64), interpolation=cv2.INTER_AREA) for image in images]).astype(
        int
    )
    bright = stack.max(axis=-1) > 0.5 * np.percentile(stack.max(axis=-1), 90)
    spread = float(np.percentile(np.ptp(stack, axis=-1)[bright], 97))
    if spread > _COLORFUL:
        return True, f"images are in color: red, green and blue differ by {spread:.0f} levels"
    return False, f"images have three channels that are alike (to {spread:.1f} levels): taken as gray"


def _lit(grays: Sequence[Image]) -> NDArray[np.uint8]:
    """1 where images are lit or change, in one piece, (rows, columns)."""
    stack = np.stack(grays).astype(np.float32)
    side = min(stack.shape[1:]) // 24 * 2 + 1
    level = cv2.blur(stack.mean(axis=0) + 3.0 * stack.std(axis=0), (side, side))
    level -= level.min()
    if not level.any():
        return np.ones(level.shape, np.uint8)
    lit = (level > _LIT * np.percentile(level, 90)).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(lit)
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])), np.uint8)


def _view(inside: NDArray[np.uint8]) -> tuple[tuple[int, int, int, int], int, str]:
    """Crop to what is inside, the radius of a mask about its middle (0: none), and that in words."""
    x, y, width, height = cv2.boundingRect(inside)
    rows, columns = inside.shape
    share, wide = float(inside[y : y + height, x : x + width].mean()), max(width, height)
    words = f"the sensor lies within {width}x{height} of {columns}x{rows} pixels"
    if min(width, height) > 0.85 * wide and abs(share - np.pi / 4) < _ROUND:
        return (x, y, x + width, y + height), (wide + 1) // 2, f"{words}, and is round"
    if width * height > 0.9 * rows * columns:
        return (0, 0, columns, rows), 0, "the sensor fills the image"
    return (x, y, x + width, y + height), 0, words


def _of_markers(grays: Sequence[Image]) -> tuple[dict[str, object], NDArray[np.uint8], str] | str:
    """Settings of a threshold, where markers lie, and why; or why there is no threshold."""
    found = [detect(image) for image in grays]
    counts = np.array([len(markers) for markers in found])
    usual = float(np.median(counts))
    if usual < _FEWEST_MARKERS or np.ptp(counts) > 2.0 * _STEADY * usual:
        return f"there are no markers that all images show ({counts.min()} to {counts.max()} spots)"
    centers = np.concatenate([markers.centers for markers in found])
    levels = [
        image[tuple(np.rint(one.centers).astype(int).T[::-1])]
        for image, one in zip(grays, found, strict=True)
    ]
    bright = float(np.median(np.concatenate(levels)))
    glare = float((np.min(grays, axis=0) > _GLARE * bright).mean())
    if glare > _FEW:
        return (
            f"spots that stay are {_GLARE:g} times as bright as the {usual:.0f} markers, as a lamp's glare is"
        )
    spacing = float(np.median([markers.spacing() for markers in found]))
    settings: dict[str, object] = {
        "median": 5 if spacing >= 16.0 else 3 if spacing >= 8.0 else 0,
        "threshold_block": max(3, round(_BLOCK * spacing) // 2 * 2 + 1),
    }
    inside = np.zeros(grays[0].shape, np.uint8)
    hull = cv2.convexHull(centers.astype(np.float32))
    cv2.fillConvexPoly(inside, np.rint(hull).astype(np.int32), 1)
    side = 2 * round(0.7 * spacing) + 1
    inside = np.asarray(
        cv2.dilate(inside, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))), np.uint8
    )
    why = f"there are {usual:.0f} markers, {spacing:.0f} px apart: a threshold shows them in any light"
    return settings, inside, why
