"""A sphere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_base.settings import Settings, setting
from tactile_scene.shapes.surface import Array, Surface


@dataclass(frozen=True)
class SphereSettings(Settings):
    """A sphere about the origin."""

    radius: float = setting(0.035, unit="m", lower=1e-3, upper=10.0, doc="radius of the sphere")


class Sphere(Surface):
    """A ball about the origin."""

    settings_class = SphereSettings
    settings: SphereSettings

    def query(self, points: Array) -> tuple[Array, Array]:
        from_center = np.sqrt(np.einsum("ij,ij->i", points, points))
        normal = points / np.maximum(from_center, 1e-300)[:, None]
        normal[from_center == 0, 2] = 1.0  # at the center any direction is as good
        return from_center - self.settings.radius, normal

    def grid(self, n: int = 60) -> Array:
        a, p = np.meshgrid(np.linspace(0.0, 2 * np.pi, n), np.linspace(np.pi, 0.0, n))
        unit = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
        return self.settings.radius * unit
