"""Markers found in a tactile image, with how densely they stand: on top of the image, for people."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_perception.estimating.image import ImageError
from tactile_perception.markers.detection import density, detect
from tactile_perception.markers.view import draw_markers

Array = NDArray[Any]

SIDE = 480  # px, the longer one, of the image in which markers are looked for
STEP = 4  # px, of the grid on which the density is computed
BRIGHTEST = 2.0  # times the usual density


def marker_picture(gray: Array) -> tuple[Array, str]:
    """RGB (rows, columns, 3) of a gray image (rows, columns) of 8 bits, and what is to be seen in words.

    The density is that of Gaussian kernels as wide as the mean distance of a marker to the next one.
    """
    scale = max(gray.shape) / SIDE
    height, width = (max(1, round(side / scale)) for side in gray.shape)
    how = cv2.INTER_AREA if scale > 1.0 else cv2.INTER_LINEAR
    image = np.asarray(cv2.resize(np.ascontiguousarray(gray), (width, height), interpolation=how), np.uint8)
    markers = detect(image)
    try:
        spacing = markers.spacing()
    except ImageError as error:
        return np.repeat(image[:, :, None], 3, axis=2), f"no density: {error}"
    rows, columns = (np.arange((STEP - 1) / 2, max(side, STEP), STEP) for side in image.shape)
    values = density(markers.centers, columns, rows, spacing)
    nearest = np.clip(markers.centers[:, ::-1] // STEP, 0, np.array(values.shape) - 1).astype(int)
    usual = float(np.median(values[tuple(nearest.T)]))
    levels = np.asarray(np.clip(values / (BRIGHTEST * usual), 0.0, 1.0) * 255.0, np.uint8)
    glow = cv2.applyColorMap(cv2.resize(levels, (width, height)), cv2.COLORMAP_INFERNO)
    picture = cv2.addWeighted(draw_markers(image, markers), 1.0, glow, 0.6, 0.0)
    words = (
        f"{len(markers)} markers, {scale * spacing:.1f} px apart, at most {values.max() / usual:.2f} times "
        "as dense as usual (black: none, yellow: twice as dense)"
    )
    return np.asarray(picture[:, :, ::-1]), words
