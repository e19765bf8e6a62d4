"""Focus: how blurred the edges of the markers are."""

from __future__ import annotations

import math

import cv2
import numpy as np

from tactile_perception.estimating.image import Image, check_image
from tactile_perception.markers.detection import DetectedMarkers

_SMOOTHING = 1.0  # px, standard deviation; noise would pass for sharp edges


def blur(image: Image, markers: DetectedMarkers) -> float:
    """Blur of the markers' edges, px: standard deviation of a Gaussian that makes a step as gradual; median.

    A step of height h that a Gaussian of standard deviation s has blurred is steepest by h / (s sqrt(2 pi)).
    Height and slope are the largest near each marker. NaN without markers.

    Raises `ImageError` if the image is not a gray image of 8 bits.
    """
    if not len(markers):
        return math.nan
    smooth = cv2.GaussianBlur(check_image(image, None, "image with markers"), (0, 0), _SMOOTHING).astype(
        np.float32
    )
    rows, columns = np.gradient(smooth)
    slope = np.hypot(rows, columns).astype(np.float32)
    side = 2 * math.ceil(2.0 * math.sqrt(float(np.median(markers.areas)) / math.pi)) + 1
    near = np.ones((side, side), np.uint8)
    column, row = np.rint(markers.centers).astype(int).T
    height = (cv2.dilate(smooth, near) - cv2.erode(smooth, near))[row, column]
    steepest = np.maximum(cv2.dilate(slope, near)[row, column], 1e-6)
    spread = float(np.median(height / steepest)) / math.sqrt(2.0 * math.pi)
    return math.sqrt(max(0.0, spread**2 - _SMOOTHING**2))
