"""A hemisphere on a plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_base.settings import Settings, setting
from tactile_scene.shapes.surface import Array, Surface


@dataclass(frozen=True)
class DomeSettings(Settings):
    """A hemisphere on a base plane."""

    radius: float = setting(0.075, unit="m", lower=0.005, upper=10.0, doc="radius of the hemisphere")


class Dome(Surface):
    """The upper half of a sphere about the origin on the plane z = 0 (the outside is above both).

    The top is at (0, 0, radius). In the crease between the two, and inside below the base, normals jump.
    """

    settings_class = DomeSettings
    settings: DomeSettings

    def query(self, points: Array) -> tuple[Array, Array]:
        radius = self.settings.radius
        x, y, z = points[:, 0], points[:, 1], points[:, 2]
        from_center = np.sqrt(x * x + y * y + z * z)
        distance = from_center - radius
        normal = points / np.maximum(from_center, 1e-300)[:, None]
        if (np.abs(distance) < z).all():
            return distance, normal
        return self._with_base(points, distance, normal, from_center)

    def _with_base(
        self, points: Array, distance: Array, normal: Array, from_center: Array
    ) -> tuple[Array, Array]:
        """The general case: nearest of cap (z > 0), plane outside the cap's foot, and the foot's circle."""
        radius, z = self.settings.radius, points[:, 2]
        in_plane = np.hypot(points[:, 0], points[:, 1])
        outward = in_plane - radius
        crease = np.hypot(outward, z)
        inside = (from_center < radius) | (z < 0)
        cap = np.where(z > 0, np.abs(distance), crease)
        base = np.where(outward >= 0, np.abs(z), crease)
        sign = np.where(inside, -1.0, 1.0)
        on_cap = (z > 0) & (cap <= base)
        on_base = (outward >= 0) & ~on_cap
        at_crease = ~on_cap & ~on_base

        result = sign * np.minimum(cap, base)
        normal = np.where(on_cap[:, None], normal, [0.0, 0.0, 1.0])
        normal[on_cap & (from_center == 0)] = (0.0, 0.0, 1.0)
        if at_crease.any():
            p, rho = points[at_crease], in_plane[at_crease]
            direction = np.where((rho > 0)[:, None], p[:, :2] / np.maximum(rho, 1e-300)[:, None], [1.0, 0.0])
            foot = np.column_stack([radius * direction, np.zeros(len(p))])
            normal[at_crease] = (foot - p) / np.maximum(crease[at_crease], 1e-300)[:, None]
        return result, normal

    def grid(self, n: int = 60) -> Array:
        azimuth = np.linspace(0.0, 2 * np.pi, n)
        polar = np.linspace(np.pi / 2, 0.0, n)
        a, p = np.meshgrid(azimuth, polar)
        unit = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
        return self.settings.radius * unit
