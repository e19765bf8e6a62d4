"""Focus: a known blur is measured, whatever the size, the contrast and the noise of the markers."""

import math

import cv2
import numpy as np
import pytest

from tactile_perception.markers.detection import detect
from tactile_perception.markers.focus import blur


def markers(radius: float, spread: float, bright: float = 200.0) -> np.ndarray:
    """Discs, blurred by a Gaussian of this standard deviation (px), with noise."""
    image = np.full((480, 640), 40.0, np.float32)
    for x in range(60, 600, 40):
        for y in range(60, 440, 40):
            cv2.circle(image, (16 * x, 16 * y), round(16 * radius), bright, -1, cv2.LINE_AA, shift=4)
    noise = np.random.default_rng(1).normal(0.0, 3.0, image.shape)
    return np.clip(cv2.GaussianBlur(image, (0, 0), spread) + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("bright", [110.0, 220.0])
@pytest.mark.parametrize("radius, spread", [(6, 1.0), (6, 2.0), (10, 1.0), (10, 2.0), (10, 3.0)])
def test_a_known_blur_is_found(radius, spread, bright):
    image = markers(radius, spread, bright)
    edges = math.hypot(spread, 0.5)  # of the discs themselves: half a pixel
    assert blur(image, detect(image)) == pytest.approx(edges, abs=0.3)


def test_more_blur_is_a_larger_figure_also_where_markers_are_small():
    figures = [
        blur(image, detect(image)) for image in (markers(4, spread) for spread in (0.5, 1.0, 2.0, 4.0))
    ]
    assert figures == sorted(figures) and figures[-1] > 3 * figures[0]


def test_without_markers_there_is_no_figure():
    image = np.zeros((480, 640), np.uint8)
    assert math.isnan(blur(image, detect(image)))
