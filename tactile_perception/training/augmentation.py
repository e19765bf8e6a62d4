"""Augmentation: changed copies of the training images for which the right label is known."""

from __future__ import annotations

from operator import itemgetter

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tactile_perception.estimating.image import Image
from tactile_perception.training.settings import AugmentationSettings
from tactile_perception.training.symmetry import (
    CropGeometry,
    Pattern,
    SymmetryAxis,
    find_center,
    find_mirror,
    glance,
    mirror_of_labels,
    patterns_at_rest,
    reflection,
    turn,
    warped,
)

Array = NDArray[np.float64]

#: Images are changed at this multiple of the network's input size and then reduced: it hides interpolation.
SCALE = 2
#: The markers' pattern has to fit itself this well to be called symmetric.
MIN_CORRELATION = 0.8
_INNER = 0.9  # of the radius of the markers' disk
#: So many images, with their turned copies, tell in which direction they are mirrored, and so many alone.
_MIRRORED, _FEWEST_MIRRORED = 3000, 20
_KERNEL = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)


class AugmentationError(ValueError):
    """Images that do not have the symmetry that the settings name."""


class Augmenter:
    """Makes batches of training images, changed at random.

    Attributes
    ----------
    center : (2,) of the markers in crop pixels
    correlation : of the pattern at rest with its turned copies; nan if the center was given
    copies : (n, 2, 2), how an image looks to the same sensor turned, and mirrored; the first is as it is
    """

    def __init__(
        self,
        images: Image,
        depth: Array,
        crop_shape: tuple[int, int],
        settings: AugmentationSettings,
        dark: float = 0.0,
        rest: Image | None = None,
    ) -> None:
        """Find the markers' center and mirror; `AugmentationError` without the symmetry that settings name.

        Parameters
        ----------
        images : uint8 (N, SCALE * size, SCALE * size[, 3])
        depth : (N,) of the contacts; the shallowest show the markers at rest
        crop_shape : (rows, columns) of the crop that the images were reduced from
        dark : the level that no light changes; mid-gray in differences to the image without contact
        rest : one more such image, without contact, if there is one
        """
        self.settings, self._dark = settings, np.float32(dark)
        self.size = images.shape[1] // SCALE
        self._geometry = CropGeometry(crop_shape, images.shape[1])
        self._radius = min(settings.symmetry_radius, min(crop_shape) / 2.0 - 1.0)
        patterns = patterns_at_rest(images, depth, rest) if settings.copies > 1 else []
        self.center, self.correlation = self._find_center(patterns)
        turns = [turn(2.0 * np.pi * k / settings.symmetry) for k in range(settings.symmetry)]
        if settings.mirror:
            mirror = reflection(self._find_mirror(patterns))
            turns += [mirror @ linear for linear in turns]
        self.copies = np.array(turns)
        self._disk = self._geometry.disk(self.center, self._radius)

    def __call__(self, images: Image, rng: np.random.Generator) -> tuple[Image, NDArray[np.int64]]:
        """Images (n, SCALE * size, SCALE * size[, 3]) as (n, size, size[, 3]), and the turns of each (n,)."""
        turns = rng.integers(0, self.settings.copies, len(images))
        result = np.empty((len(images), self.size, self.size, *images.shape[3:]), np.uint8)
        for image, large, k in zip(result, images, turns, strict=True):
            changed = self._changed(large, int(k), rng)
            cv2.resize(changed, (self.size, self.size), dst=image, interpolation=cv2.INTER_AREA)
        return result, turns

    def turned(self, image: Image, k: int) -> Image:
        """One image (SCALE * size) with its disk as in the k-th of `copies`."""
        if k == 0:
            return image
        inverse = self._geometry.inverse_map(self.copies[k], self.center, np.zeros(2))
        return np.where(self._disk, warped(image, inverse), image)

    def axis(self, images: Image, labels: Array, directed: bool) -> SymmetryAxis:
        """The axis that labels are turned about, as it is at first; where images are mirrored, that as well.

        Parameters
        ----------
        images : uint8 (N, SCALE * size, SCALE * size)
        labels, directed : (N, 6 or more), as of `SymmetryAxis`
        """
        settings = self.settings
        given = settings.symmetry_axis, settings.symmetry, settings.symmetry_sense
        turned = SymmetryAxis(*given, directed=directed)
        if not settings.mirror:
            return turned
        order = settings.symmetry
        images = images[: max(_FEWEST_MIRRORED, _MIRRORED // order)]
        repeated = torch.from_numpy(np.tile(labels[: len(images)], (order, 1))).float()
        copies, mirrored = (
            np.array([glance(self.turned(image, k)) for k in range(first, first + order) for image in images])
            for first in (0, order)
        )
        turns = torch.arange(order).repeat_interleave(len(images))
        with torch.no_grad():
            known = turned(repeated, turns).numpy()
        return SymmetryAxis(*given, mirror_of_labels(copies, mirrored, known, directed), directed)

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

    def _find_center(self, patterns: list[Pattern]) -> tuple[Array, float]:
        settings = self.settings
        if settings.symmetry_center:
            return np.array(settings.symmetry_center), float("nan")
        if settings.symmetry == 1:
            return self._geometry.to_crop(np.full(2, (self._geometry.side - 1) / 2.0)), float("nan")
        found = [
            find_center(pattern, self._geometry, settings.symmetry, self._inner_radius)
            for pattern in patterns
        ]
        center, correlation = max(found, key=itemgetter(1))
        if correlation < MIN_CORRELATION:
            raise AugmentationError(
                f"augmentation.symmetry = {settings.symmetry}: the markers do not look the same after a turn "
                f"(best correlation {correlation:.2f} about {center.round(1)}, needs {MIN_CORRELATION}); "
                "set symmetry = 1, or symmetry_center and symmetry_radius to the markers' disk"
            )
        return center, correlation

    def _find_mirror(self, patterns: list[Pattern]) -> float:
        """Direction of the mirror's line in the image."""
        found = [
            find_mirror(pattern, self._geometry, self.center, self.settings.symmetry, self._inner_radius)
            for pattern in patterns
        ]
        direction, correlation = max(found, key=itemgetter(1))
        if correlation < MIN_CORRELATION:
            raise AugmentationError(
                "augmentation.mirror = true: the markers do not look the same in any mirror (best "
                f"correlation {correlation:.2f} at {np.degrees(direction):.0f} deg, needs "
                f"{MIN_CORRELATION}); set mirror = false, or symmetry_center and symmetry_radius to the "
                "markers' disk"
            )
        return direction

    @property
    def _inner_radius(self) -> float:
        """Of what is compared, without the rim of the markers' disk."""
        return _INNER * self._radius


def without_markers(image: Image, probability: float, rng: np.random.Generator) -> Image:
    """The image with each white spot painted black with this probability."""
    count, spots = cv2.connectedComponents((image > 127).astype(np.uint8), connectivity=4)
    gone = rng.random(count) < probability
    gone[0] = False
    # A spot's gray rim goes with it.
    mask = cv2.dilate(gone[spots].astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.where(mask > 0, np.uint8(0), image)
