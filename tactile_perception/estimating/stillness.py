"""Do images show more than their noise? A skin that slides, or that an arm presses, never stands still.

No two images of a camera are equal, also of a scene that has stood still for long: they differ by the noise
of its pixels. Noise is new in each image, so that the means of `FRAMES` images differ by that much less; what
moves does not get less. Of a contact that an arm follows on a plane, the most even one there is, the means of
64 images vary by 3 to 10 % beyond their noise, and by 1.1 % at least (20 seeds of the simulated sensor; 2.3 %
if three groups in a row are taken); on other surfaces by far more; before a frozen scene, or a picture of
one, by less than 1 %.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from tactile_perception.estimating.image import Image

FRAMES = 8  # images that are averaged
_PIXELS = 20_000  # of an image that are looked at, about


class Stillness:
    """Compares the variance of the means of `FRAMES` images with that of noise within them.

    Parameters
    ----------
    images : int
        Over how many it looks; whole groups of `FRAMES`, two at least.
    least_change : float
        The part of the noise's variance by which the means have to vary more, so that something moves; 0:
        nothing is said to be still.

    Attributes
    ----------
    still : bool
        Whether the last `images` showed nothing but noise; False before there are as many.
    change : float
        By which part of the noise's variance their means vary more; NaN before.
    """

    def __init__(self, images: int = 64, least_change: float = 0.013) -> None:
        self.configure(images, least_change)

    def configure(self, images: int, least_change: float) -> None:
        """Look for something else from now on."""
        self._groups = max(2, images // FRAMES)
        self._least = least_change
        self._shape: tuple[int, ...] = ()
        self._forget()

    def _forget(self) -> None:
        self.still, self.change = False, math.nan
        self._means: deque[tuple[NDArray[np.float64], float, float]] = deque()
        self._sum = np.zeros(1)
        self._squares = self._noise = 0.0
        self._begin()

    def _begin(self) -> None:
        """A new group."""
        self._number, self._differences = 0, 0.0
        self._gathered: NDArray[np.float32] = np.zeros(1, np.float32)
        self._before: NDArray[np.float32] | None = None

    def add(self, image: Image) -> None:
        """Take the next image, uint8; one of another size is the first of others."""
        if image.shape != self._shape:
            self._forget()
            self._shape = image.shape
        stride = max(1, round(math.sqrt(image.shape[0] * image.shape[1] / _PIXELS)))
        pixels = image[::stride, ::stride].astype(np.float32).ravel()
        if self._before is None:
            self._gathered = pixels.copy()
        else:
            self._gathered += pixels
            difference = pixels - self._before
            self._differences += float(difference @ difference)
        self._before = pixels
        self._number += 1
        if self._number == FRAMES:
            self._close()
            self._begin()

    def _close(self) -> None:
        """A group is complete: by what the means of the latest vary, against what noise alone would make.

        The sums are of whole numbers, so that taking the oldest off again leaves no rounding.
        """
        gathered = self._gathered.astype(np.float64)
        squares = float(gathered @ gathered)
        noise = self._differences / (2.0 * (FRAMES - 1))  # of one image, summed over its pixels
        if not self._means:
            self._sum = np.zeros_like(gathered)
        self._means.append((gathered, squares, noise))
        self._sum += gathered
        self._squares += squares
        self._noise += noise
        if len(self._means) > self._groups:
            oldest, squares, noise = self._means.popleft()
            self._sum -= oldest
            self._squares -= squares
            self._noise -= noise
        count = len(self._means)
        if count < self._groups:
            return
        varies = (self._squares - float(self._sum @ self._sum) / count) / (count - 1)
        by_noise = FRAMES * max(self._noise, 0.0) / count  # of a sum of FRAMES images
        self.change = varies / by_noise - 1.0 if by_noise > 0.0 else math.inf if varies > 0.0 else 0.0
        self.still = self._least > 0.0 and self.change < self._least
