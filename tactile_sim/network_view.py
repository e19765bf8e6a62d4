"""What a network sees of a simulated sensor, drawn at the size of the network's input.

A camera image is drawn at 640x480, then cropped, filtered, thresholded and made smaller. Where nobody else
looks at the image, `NetworkView` draws the result of all that at once, in a fifth of the time. The network's
answers differ from those to the full image by less than they differ between two images of the same contact
that differ in noise only by a few times; test/sim/test_network_view.py has the numbers that are held.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_sim import _contact
from tactile_sim.camera import Camera

Array = NDArray[np.float64]
#: By the side of the median filter, what it takes off the radius r of a disc, times r^2 (px^3): means over
#: discs of 4 to 9 px at random places.
_MEDIAN_BEND = {0: 0.0, 3: 0.62, 5: 6.6}


@dataclass(frozen=True)
class ViewSettings:
    """How a network's input is made of a camera image, in the image's pixels.

    Attributes
    ----------
    bbox : x0, y0, x1, y1 of the crop, ends exclusive
    median : side of the median filter, 0 for none
    block, offset : side of the threshold's neighbourhood, and gray levels below its mean that are white
    circle : radius of the circle about the crop's middle outside of which all is black; 0: none
    size : side of the input
    """

    bbox: tuple[int, int, int, int]
    median: int
    block: int
    offset: float
    circle: int
    size: int


class NetworkView:
    """Draws the input of one network from the markers before one camera."""

    def __init__(self, camera: Camera, view: ViewSettings) -> None:
        x0, y0, x1, y1 = view.bbox
        self._camera, self._size = camera, view.size
        width, height = (x1 - x0) / view.size, (y1 - y0) / view.size
        columns = x0 + (np.arange(view.size) + 0.5) * width
        rows = y0 + (np.arange(view.size) + 0.5) * height
        self._ground = np.ascontiguousarray(camera.ground[np.ix_(rows.astype(int), columns.astype(int))])
        self._mask = _circle(view, width, height)
        # median of n pixels: sqrt(pi / 2 n) of their noise; then whole gray levels
        noise = camera.settings.noise_gray * np.sqrt(np.pi / 2.0) / max(view.median, 1)
        self._view = (
            float(x0), float(y0), width, height, camera.settings.edge_width, _MEDIAN_BEND[view.median],
            float(view.block), 0.5 - np.ceil(view.offset), float(np.hypot(noise, 12**-0.5)),
        )  # fmt: skip

    def draw(self, points: Array) -> NDArray[np.uint8]:
        """Input (size, size) for markers at points (n, 3) m in {s}: 0 black, 255 white."""
        image = np.empty((self._size, self._size), dtype=np.uint8)
        _contact.draw_input(image, self._camera.discs(points), self._ground, self._mask, self._view)
        return image


def _circle(view: ViewSettings, width: float, height: float, fine: int = 8) -> NDArray[np.float32]:
    """Part of each cell (size, size) inside the circle."""
    if view.circle == 0:
        return np.ones((view.size, view.size), np.float32)
    x0, y0, x1, y1 = view.bbox
    at = (np.arange(view.size * fine) + 0.5) / fine
    across = at * width - ((x1 - x0) // 2 + 0.5)
    down = at * height - ((y1 - y0) // 2 + 0.5)
    inside = across[None] ** 2 + down[:, None] ** 2 <= (view.circle + 0.5) ** 2
    return inside.reshape(view.size, fine, view.size, fine).mean(axis=(1, 3)).astype(np.float32)
