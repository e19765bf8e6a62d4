"""A plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_base.settings import Settings, setting
from tactile_scene.shapes.surface import Array, Surface


@dataclass(frozen=True)
class PlaneSettings(Settings):
    """A plane; the size is only that of its picture."""

    width: float = setting(0.1, unit="m", lower=0.0, upper=10.0, doc="extent of the drawn part along x")
    length: float = setting(0.2, unit="m", lower=0.0, upper=10.0, doc="extent of the drawn part along y")


class Plane(Surface):
    """The plane z = 0 with the outside at z > 0."""

    settings_class = PlaneSettings
    settings: PlaneSettings

    def query(self, points: Array) -> tuple[Array, Array]:
        normal = np.zeros((len(points), 3))
        normal[:, 2] = 1.0
        return points[:, 2].copy(), normal

    def grid(self, n: int = 60) -> Array:
        half_x, half_y = self.settings.width / 2, self.settings.length / 2
        x, y = np.meshgrid(np.linspace(-half_x, half_x, n), np.linspace(-half_y, half_y, n))
        return np.stack([x, y, np.zeros_like(x)], axis=-1)
