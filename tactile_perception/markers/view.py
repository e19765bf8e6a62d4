"""Pictures of markers: those found, and the change of their density against the state without contact."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_perception.estimating.image import Image
from tactile_perception.markers.detection import DensityChange, DetectedMarkers

FULL_SCALE = 0.5  # change of density (markers per squared spacing) shown in the strongest color
_GREEN, _ORANGE = (80, 220, 80), (40, 160, 255)  # BGR: found, split off a merged blob


def draw_markers(image: Image, markers: DetectedMarkers) -> Image:
    """The image (rows, columns) with a ring on each marker: BGR (rows, columns, 3)."""
    picture = cv2.cvtColor(image // 2, cv2.COLOR_GRAY2BGR)
    radius = round(float(np.sqrt(np.median(markers.areas) / np.pi))) if len(markers) else 0
    for (column, row), merged in zip(np.rint(16 * markers.centers).astype(int), markers.merged, strict=True):
        color = _ORANGE if merged else _GREEN
        cv2.circle(picture, (int(column), int(row)), 16 * (radius + 1), color, 1, cv2.LINE_AA, shift=4)
    return np.asarray(picture, np.uint8)


def draw_density(change: DensityChange, markers: DetectedMarkers, shape: tuple[int, int]) -> Image:
    """The change of density, blue where markers have parted and red where they are closer."""
    picture = cv2.resize(_colors(change.values), shape[::-1], interpolation=cv2.INTER_LINEAR)
    for column, row in np.rint(16 * markers.centers).astype(int):
        cv2.circle(picture, (int(column), int(row)), 24, (60, 60, 60), -1, cv2.LINE_AA, shift=4)
    return np.asarray(picture, np.uint8)


def side_by_side(image: Image, markers: DetectedMarkers, change: DensityChange) -> Image:
    """Both pictures beside each other: BGR (rows, 2 columns, 3)."""
    both = (draw_markers(image, markers), draw_density(change, markers, (image.shape[0], image.shape[1])))
    return np.concatenate(both, axis=1)


def _colors(values: NDArray[np.float64]) -> Image:
    """Blue over white to red: BGR (rows, columns, 3)."""
    share = np.clip(values / FULL_SCALE, -1.0, 1.0)[..., None]
    blue, white, red = (np.array(color, float) for color in ((172, 102, 33), (247, 247, 247), (43, 24, 178)))
    end = np.where(share < 0, blue, red)
    return np.asarray(np.rint(white + np.abs(share) * (end - white)), np.uint8)
