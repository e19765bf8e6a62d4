"""Augmentation: changed copies of the training images for which the right label is known."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_perception.estimating.image import Image
from tactile_perception.training.settings import AugmentationSettings
from tactile_perception.training.symmetry import CropGeometry, find_center, turn, warped

Array = NDArray[np.float64]

#: Images are changed at this multiple of the network's input size and then reduced: it hides interpolation.
SCALE = 2
#: The markers' pattern has to fit itself this well to be called symmetric.
MIN_CORRELATION = 0.8
_KERNEL = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)


class AugmentationError(ValueError):
    """Images that do not have the symmetry that the settings name."""


class Augmenter:
    """Makes batches of training images, changed at random.

    Attributes
    ----------
    center : (2,) of the markers in crop pixels
    correlation : of the pattern at rest with its turned copies; nan if the center was given
    """

    def __init__(
        self,
        images: Image,
        depth: Array,
        crop_shape: tuple[int, int],
        settings: AugmentationSettings,
        dark: float = 0.0,
    ) -> None:
        """Find the markers' center; `AugmentationError` if they do not have the symmetry that settings name.

        Parameters
        ----------
        images : uint8 (N, SCALE * size, SCALE * size[, 3])
        depth : (N,) of the contacts; the shallowest show the markers at rest
        crop_shape : (rows, columns) of the crop that the images were reduced from
        dark : the level that no light changes; mid-gray in differences to the image without contact
        """
        self.settings, self._dark = settings, np.float32(dark)
        self.size = images.shape[1] // SCALE
        self._geometry = CropGeometry(crop_shape, images.shape[1])
        self.center, self.correlation = self._find_center(images, depth)
        self._disk = self._geometry.disk(self.center, settings.symmetry_radius)

    def __call__(self, images: Image, rng: np.random.Generator) -> tuple[Image, NDArray[np.int64]]:
        """Images (n, SCALE * size, SCALE * size[, 3]) as (n, size, size[, 3]), and the turns of each (n,)."""
        turns = rng.integers(0, self.settings.symmetry, len(images))
        result = np.empty((len(images), self.size, self.size, *images.shape[3:]), np.uint8)
        for image, large, k in zip(result, images, turns, strict=True):
            changed = self._changed(large, int(k), rng)
            cv2.resize(changed, (self.size, self.size), dst=image, interpolation=cv2.INTER_AREA)
        return result, turns

    def turned(self, image: Image, k: int) -> Image:
        """One image (SCALE * size) with its disk turned by k / symmetry of a circle."""
        if k == 0:
            return image
        angle = 2.0 * np.pi * k / self.settings.symmetry
        inverse = self._geometry.inverse_map(turn(angle), self.center, np.zeros(2))
        return np.where(self._disk, warped(image, inverse), image)

    def _changed(self, image: Image, k: int, rng: np.random.Generator) -> Image:
        settings = self.settings
        image = self.turned(image, k)
        if settings.shift or settings.turn:
            linear = turn(np.radians(settings.turn) * rng.standard_normal())
            shift = settings.shift * rng.standard_normal(2)
            image = warped(image, self._geometry.inverse_map(linear, self.center, shift))
        if settings.marker_dropout:
            image = without_markers(image, settings.marker_dropout, rng)
        if settings.growth and rng.random() < settings.growth:
            grown = (cv2.dilate if rng.random() < 0.5 else cv2.erode)(image, _KERNEL)
            image = np.asarray(grown, np.uint8)
        if settings.gain:
            factor = np.float32(np.exp(settings.gain * rng.standard_normal()))
            image = np.clip(self._dark + factor * (image - self._dark), 0.0, 255.0).astype(np.uint8)
        return image

    def _find_center(self, images: Image, depth: Array) -> tuple[Array, float]:
        settings = self.settings
        if settings.symmetry_center:
            return np.array(settings.symmetry_center), float("nan")
        if settings.symmetry == 1:
            return self._geometry.to_crop(np.full(2, (self._geometry.side - 1) / 2.0)), float("nan")
        center, correlation = find_center(
            images, depth, self._geometry, settings.symmetry, settings.symmetry_radius - 9.0
        )
        if correlation < MIN_CORRELATION:
            raise AugmentationError(
                f"augmentation.symmetry = {settings.symmetry}: the markers do not look the same after a turn "
                f"(best correlation {correlation:.2f} about {center.round(1)}, needs {MIN_CORRELATION}); "
                "set symmetry = 1, or symmetry_center and symmetry_radius to the markers' disk"
            )
        return center, correlation


def without_markers(image: Image, probability: float, rng: np.random.Generator) -> Image:
    """The image with each white spot painted black with this probability."""
    count, spots = cv2.connectedComponents((image > 127).astype(np.uint8), connectivity=4)
    gone = rng.random(count) < probability
    gone[0] = False
    # A spot's gray rim goes with it.
    mask = cv2.dilate(gone[spots].astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.where(mask > 0, np.uint8(0), image)
