"""Novelty: is an image like those that a network was trained on? By each pixel's own spread in training.

A network answers to images of another sensor, of a camera that was turned, or through a lens that is no
longer clean, and its sigma does not tell. But where markers never come, and where parts of the sensor never
move, training images hardly vary, and an image of something else does not respect that. The mean over all
pixels of

    ((image - mean) / (spread + 0.01))^2

tells real sensors apart better than a density of the network's features, or than what a subspace of training
images leaves over (docs/results/perception.md). It cannot tell an image that differs in nothing but how its
markers lie among each other, and hardly a blur, which the features tell. Nor can it tell another light, where
levels are kept: each pixel varies by more from contact to contact. But the mean over all pixels varies by a
few percent, and tells it, if not in a difference to an image of the same light::

    novelty = Novelty.fit(images)         # of the training images
    novelty(preprocessor(image))          # 1: the limit, beyond which the image is not believed
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tactile_base.input_file import parse_json
from tactile_perception.estimating.image import Image, ImageError, packed, unpacked
from tactile_perception.estimating.preprocessing import PreprocessingSettings, as_input

Array = NDArray[np.float32]

FLOOR = np.float32(0.01)  # on each pixel's spread, of 0 to 1: gray levels are rounded, training data finite
_MARGIN, _RARE, _USUAL = 1.5, 0.995, 0.99
_LEAST_LIGHT = 0.1  # an image without contact is up to 8 % off where training began 2.5 mm deep (simulated)
_AT_ONCE, _LATEST = 256, 600  # images


class NoveltyError(ValueError):
    """What is no `Novelty`, or cannot be fitted."""


@dataclass(frozen=True)
class Novelty:
    """Mean and standard deviation of each pixel of the training images, and what is usual of them.

    Attributes
    ----------
    mean, spread : uint8 (size, size), or in color (size, size, 3)
    limit : float
        1.5 times what 99.5 % of the training images stay below, each measured against all others.
    usual : float
        What 99 % of them stay below, as a part of the limit.
    light : float
        Logarithm of the factor by which images may be brighter or darker than those of the training are in
        the mean: 1.5 times what 99.5 % of these stay below, and at least 0.1; infinite where levels tell
        nothing of the light.
    """

    mean: Image
    spread: Image
    limit: float
    usual: float
    light: float = math.inf

    def __call__(self, prepared: Array) -> float:
        """Of the network's input, (size, size) or (1, channels, size, size): 0 and up; foreign above 1."""
        deviation = (prepared.reshape(self._center.shape) - self._center) * self._weight
        by_pixels = float(np.vdot(deviation, deviation)) / (deviation.size * self.limit)
        if math.isinf(self.light):
            return by_pixels
        return max(by_pixels, abs(math.log(_level(prepared) / self._level)) / self.light)

    def growth(self, novelty: float) -> float:
        """Factor on an estimate's standard deviations: 1 up to what is usual, 2 at the limit."""
        return 1.0 + max(0.0, (novelty - self.usual) / (1.0 - self.usual))

    @cached_property
    def _center(self) -> Array:
        return as_input(self.mean)[0]

    @cached_property
    def _level(self) -> float:
        return _level(self._center)

    @cached_property
    def _weight(self) -> Array:
        return 1.0 / (as_input(self.spread)[0] + FLOOR)

    @classmethod
    def fit(cls, images: Image, tolerated_light: float = math.inf) -> Novelty:
        """Of prepared images (N, size, size[, 3]), uint8; `NoveltyError` for fewer than three.

        `tolerated_light` is a lower bound of `light`: what a network was trained to bear. Infinite, as by
        default, is for images that have been through a threshold.
        """
        count = len(images)
        if count < 3:
            raise NoveltyError(f"novelty: needs at least three images, has {count}")
        total, squares = np.zeros(images.shape[1:]), np.zeros(images.shape[1:])
        for image in images:
            scaled = image * (1.0 / 255.0)
            total += scaled
            squares += scaled**2
        scores = np.concatenate(
            [
                _left_out(images[start : start + _AT_ONCE], total, squares, count)
                for start in range(0, count, _AT_ONCE)
            ]
        )
        limit = _MARGIN * float(np.quantile(scores, _RARE))
        mean, spread = _moments(total, squares, count)
        levels = [np.rint(255.0 * values).astype(np.uint8) for values in (mean, spread)]
        usual = float(np.quantile(scores, _USUAL)) / limit
        middle = _level(as_input(levels[0]))
        off = [abs(math.log(_level(as_input(image)) / middle)) for image in images]
        rare, common = np.quantile(off, (_RARE, _USUAL))
        light = float(max(_MARGIN * rare, common / usual, _LEAST_LIGHT, tolerated_light))
        return cls(levels[0], levels[1], limit, usual, light)

    def to_text(self) -> str:
        """As JSON with PNGs in base64, for a model's metadata."""
        images = {"mean": packed(self.mean), "spread": packed(self.spread)}
        light = {} if math.isinf(self.light) else {"light": self.light}
        return json.dumps({**images, "limit": self.limit, "usual": self.usual, **light})

    @classmethod
    def from_text(cls, text: str, settings: PreprocessingSettings) -> Novelty:
        """The reverse; `NoveltyError` says what is wrong."""
        try:
            values = parse_json(text)
            mean, spread = (unpacked(values[name], name, settings.color) for name in ("mean", "spread"))
            limit, usual = float(values["limit"]), float(values["usual"])
            light = float(values.get("light", math.inf))  # models from before do not tell it
        except (ImageError, ValueError, TypeError, KeyError) as error:
            raise NoveltyError(f"novelty: must hold mean, spread, limit and usual: {error!r}") from error
        shape = (settings.size, settings.size, 3)[: 2 + settings.color]
        if mean.shape != shape or spread.shape != shape:
            raise NoveltyError(
                f"novelty: mean and spread are {mean.shape} and {spread.shape}, must be {shape}"
            )
        if not (0.0 < limit < np.inf and 0.0 < usual < 1.0):
            raise NoveltyError(f"novelty: limit is {limit}, usual {usual}: must be positive, usual below 1")
        if not light > 0.0:
            raise NoveltyError(f"novelty: light is {light}: must be positive")
        return cls(mean, spread, limit, usual, light)


class NoveltyDrift:
    """The mean novelty of the latest images, some ten seconds of them: a camera that slowly changes.

    Attributes
    ----------
    mean : float
        NaN before the first image.
    """

    def __init__(self) -> None:
        self.mean, self._count = math.nan, 0

    def add(self, novelty: float) -> None:
        """Take one image's; NaN, where it is not known, is none."""
        if not math.isnan(novelty):
            self._count = min(self._count + 1, _LATEST)
            self.mean = novelty if self._count == 1 else self.mean + (novelty - self.mean) / self._count

    def complaint(self, usual: float) -> str:
        """What is to be said of a mean beyond what single images of the training have; else empty."""
        if self._count < _LATEST or self.mean <= usual:
            return ""
        return (
            f"images have become unlike those of the training: by {self.mean:.2f} in the mean, usual is up "
            f"to {usual:.2f}, and 1 is refused: is the lens clean, and are camera and light as they were?"
        )


def _level(prepared: Array) -> float:
    """The mean over all pixels, 0 to 1; above 0."""
    return max(float(prepared.mean()), 1e-6)


def _moments(total: NDArray, squares: NDArray, count: int) -> tuple[NDArray, NDArray]:
    """Mean and standard deviation by the sums of so many values and of their squares."""
    mean = total / count
    return mean, np.sqrt(np.maximum(squares / count - mean**2, 0.0))


def _left_out(images: Image, total: NDArray, squares: NDArray, count: int) -> NDArray:
    """The measure (N,) of images, each by the moments of all `count` but itself."""
    scaled = images * (1.0 / 255.0)
    mean, spread = _moments(total - scaled, squares - scaled**2, count - 1)
    return np.asarray((((scaled - mean) / (spread + FLOOR)) ** 2).mean(axis=(1, 2)))
