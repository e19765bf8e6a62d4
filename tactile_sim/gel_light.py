"""Gel in colored light: what a camera behind the skin sees where lamps, not markers, show how the skin lies.

Three lamps at the rim, red, green and blue, shine on the inside of the skin, which is painted matt: each
color's brightness falls with the slope of the skin towards its lamp (Lambert's law) and with the square of
the distance to it. So see sensors of the GelSight family (Yuan, Dong, Adelson, "GelSight: High-resolution
robot tactile sensors for estimating geometry and force", Sensors 17(12), 2017).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_scene.simulated_sensors import LightSettings
from tactile_sim.camera import Camera
from tactile_sim.markers import SkinPoints
from tactile_sim.skin import Skin

Array = NDArray[np.float64]
_CELL = 4  # px, side of the cells of which the light is computed
_STEPS = 20  # of Newton's method, to see through the lens


class GelLight:
    """The ground of the image, in place of the camera's own, for one skin before one camera."""

    def __init__(self, settings: LightSettings, camera: Camera, skin: Skin, radius: float) -> None:
        self._camera, self._radius = camera, radius
        self._shape = camera.ground.shape
        height, width = self._shape
        rows, columns = (np.arange(0.5 * _CELL - 0.5, side, _CELL) for side in (height, width))
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
        base = _seen(camera, pixels.reshape(-1, 2), radius)
        self._cells = pixels.shape[:2]
        self._there = np.isfinite(base[:, 0])
        self._points = SkinPoints(base[self._there] / radius, skin, radius)
        self._rest = self._camera.project(radius * self._points.normals)[0]
        azimuth = np.radians(settings.azimuth_deg) + 2.0 * np.pi / 3.0 * np.array(
            [2, 1, 0]
        )  # blue, green, red
        self._lamps = radius * np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(3)], axis=1)
        self._ambient, self._strength = settings.ambient_gray, settings.lamp_gray
        self._pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)

    def grounds(self, displacement: NDArray[np.float32]) -> NDArray[np.float32]:
        """Levels (3, height, width) of blue, green and red for displacements (nodes, 3) m of the skin."""
        position, normal = self._points.moved(displacement)
        shade = np.zeros((*self._cells, 3), np.float32)
        shade.reshape(-1, 3)[self._there] = self._shade(position, normal)
        flow = np.zeros((*self._cells, 2), np.float32)
        flow.reshape(-1, 2)[self._there] = self._camera.project(position)[0] - self._rest
        size = (self._shape[1], self._shape[0])
        flow = cv2.resize(flow, size, interpolation=cv2.INTER_LINEAR)
        shade = cv2.resize(shade, size, interpolation=cv2.INTER_LINEAR)
        # what lies at a pixel now is what lay there, less the way that it has gone
        columns, rows = (np.ascontiguousarray((self._pixels - flow)[:, :, k], np.float32) for k in (0, 1))
        moved = cv2.remap(shade, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.ascontiguousarray(np.moveaxis(moved * self._camera.gain[:, :, None], -1, 0), np.float32)

    def _shade(self, position: Array, normal: Array) -> Array:
        """Levels (n, 3) of light on the inside of the skin at points (n, 3) with outward normals."""
        to_lamp = self._lamps[None] - position[:, None]
        distance = np.linalg.norm(to_lamp, axis=2)
        falls = np.maximum(-np.einsum("nkd,nd->nk", to_lamp, normal) / distance, 0.0)
        return self._ambient + self._strength * falls * (self._radius / distance) ** 2


def _seen(camera: Camera, pixels: Array, radius: float) -> Array:
    """Points (n, 3) m in {s} of the dome at rest that are seen at pixels (n, 2); NaN beside it."""
    q = camera.directions(pixels, _STEPS)
    ray = np.column_stack([q, np.ones(len(q))])
    start = np.array([0.0, 0.0, -camera.settings.distance])
    a, b = np.sum(ray**2, axis=1), ray @ start
    root = b**2 - a * (start @ start - radius**2)
    with np.errstate(invalid="ignore"):
        point = start + ((-b + np.sqrt(root)) / a)[:, None] * ray
        point[~(point[:, 2] > 0.02 * radius)] = np.nan  # its back is clamped
    return point
