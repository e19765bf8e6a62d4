"""The camera inside the sensor: marker positions to gray images.

A pinhole with radial distortion looks along {s}'s z axis from behind the dome; markers are bright discs on a
dark ground that brightens towards its middle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_scene.simulated_sensors import CameraSettings
from tactile_sim import _contact

Array = NDArray[np.float64]
_NOISE_LEVELS = 4096


class Camera:
    """Projects and draws markers; images depend only on the settings, the markers and the frame's seed.

    Attributes
    ----------
    ground : (height, width) float32
        Gray levels where there is no marker.
    gain : (height, width)
        By which light is brighter there.
    """

    def __init__(self, settings: CameraSettings) -> None:
        self.settings = settings
        shape = (settings.height, settings.width)
        self._gain_at = _vignette(settings)
        self.gain = settings.gain * self._gain_at
        self.ground: NDArray[np.float32] = (settings.gain * settings.ground_gray * self._gain_at).astype(
            np.float32
        )
        self._canvas = np.empty(shape, dtype=np.float32)
        quantiles = _normal_quantiles(_NOISE_LEVELS)
        self._noise = (settings.noise_gray * quantiles).astype(np.float32) if settings.noise_gray else None
        angle = np.radians(settings.rotation_deg)
        self._axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    def project(self, points: Array) -> tuple[Array, Array]:
        """Image positions (n, 2) (column, row) and scale (n,) px/m of points (n, 3) m in {s}."""
        settings = self.settings
        away = settings.distance + points[:, 2]
        if np.any(away <= 0):
            raise ValueError(f"a marker lies {-away.min():.4f} m behind the camera")
        q = points[:, :2] @ self._axes.T / away[:, None]
        square = np.sum(q * q, axis=1)
        stretch = 1 + square * (settings.distortion[0] + settings.distortion[1] * square)
        pixels = settings.focal_length * stretch[:, None] * q + (settings.center_column, settings.center_row)
        return pixels, settings.focal_length * stretch / away

    def directions(self, pixels: Array, steps: int) -> Array:
        """Tangents (n, 2) of the angles to the axis, in the axes of {s}, at image positions (n, 2).

        The reverse of `project`, by so many steps of Newton's method.
        """
        settings = self.settings
        bent = (pixels - [settings.center_column, settings.center_row]) / settings.focal_length
        length = np.linalg.norm(bent, axis=1)
        found, (k1, k2) = length.copy(), settings.distortion
        for _ in range(steps):
            square = found * found
            slope = 1.0 + square * (3.0 * k1 + 5.0 * k2 * square)
            found -= (found * (1.0 + square * (k1 + k2 * square)) - length) / np.maximum(slope, 0.1)
        return np.asarray((bent * (found / np.maximum(length, 1e-12))[:, None]) @ self._axes)

    def draw(self, points: Array, seed: int, ground: NDArray[np.float32] | None = None) -> NDArray[np.uint8]:
        """Gray image (height, width) of markers at points (n, 3) m in {s}; `seed` selects the noise.

        `ground` stands for another one than the camera's own.
        """
        settings, discs = self.settings, self.discs(points)
        ground = self.ground if ground is None else ground
        image = np.empty((settings.height, settings.width), dtype=np.uint8)
        _contact.render(image, ground, discs, settings.edge_width, self._noise, seed, self._canvas)
        return image

    def discs(self, points: Array) -> Array:
        """Markers (n, 4) in the image: column, row, radius (px) and gray level."""
        settings = self.settings
        pixels, scale = self.project(points)
        blobs = np.empty((len(points), 4))
        blobs[:, :2] = pixels
        middle = settings.focal_length / settings.distance
        blobs[:, 2] = settings.marker_radius * middle * (scale / middle) ** settings.marker_perspective
        column, row = np.rint(pixels).astype(int).T
        shade = self._gain_at[row.clip(0, settings.height - 1), column.clip(0, settings.width - 1)]
        blobs[:, 3] = settings.gain * settings.marker_gray * shade
        return blobs


def _vignette(settings: CameraSettings) -> Array:
    """Relative brightness (height, width), one on the axis, falling with the square of the distance to it."""
    row, column = np.mgrid[: settings.height, : settings.width]
    square = (row - settings.center_row) ** 2 + (column - settings.center_column) ** 2
    corner = (settings.height**2 + settings.width**2) / 4
    return np.asarray(np.clip(1 - settings.vignette * square / corner, 0.0, 1.0))


def _normal_quantiles(count: int) -> Array:
    """Quantiles of the standard normal at the middles of `count` equal intervals."""
    from statistics import NormalDist

    normal = NormalDist()
    return np.array([normal.inv_cdf((k + 0.5) / count) for k in range(count)])
