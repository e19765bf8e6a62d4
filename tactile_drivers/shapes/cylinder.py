"""A cylinder, with flat ends or without end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_base.settings import Settings, setting
from tactile_drivers.shapes.surface import Array, Surface

_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class CylinderSettings(Settings):
    """A cylinder about the origin."""

    radius: float = setting(0.03, unit="m", lower=1e-3, upper=10.0, doc="radius of the round side")
    height: float = setting(0.1, unit="m", lower=1e-3, upper=10.0, doc="from end to end along the axis")
    axis: str = setting("z", choices=_AXES, doc="axis of its own frame that it lies along")
    ends: bool = setting(True, doc="flat ends; without them `height` is only that of its picture")


class Cylinder(Surface):
    """All points within `radius` of the axis and, with ends, within half the `height` of the origin."""

    settings_class = CylinderSettings
    settings: CylinderSettings

    @property
    def _turn(self) -> int:
        """Steps of x -> y -> z -> x that take the z axis to the cylinder's."""
        return _AXES.index(self.settings.axis) + 1

    def query(self, points: Array) -> tuple[Array, Array]:
        s, points = self.settings, np.roll(points, -self._turn, axis=1)
        across = np.hypot(points[:, 0], points[:, 1])
        radial = np.zeros((len(points), 3))
        radial[:, :2] = points[:, :2] / np.maximum(across, 1e-300)[:, None]
        radial[across == 0, 0] = 1.0  # on the axis any direction is as good
        distance, normal = across - s.radius, radial
        if s.ends:
            distance, normal = _with_ends(points[:, 2], distance, radial, s.height / 2)
        return distance, np.roll(normal, self._turn, axis=1)

    def grid(self, n: int = 60) -> Array:
        s = self.settings
        azimuth = np.linspace(0.0, 2 * np.pi, n)
        circle = s.radius * np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(n)])
        end = np.array([0.0, 0.0, s.height / 2])
        rows = [circle - end, circle + end]
        if s.ends:
            rows = [np.tile(-end, (n, 1)), *rows, np.tile(end, (n, 1))]
        return np.roll(np.stack(rows), self._turn, axis=-1)


def _with_ends(z: Array, side: Array, radial: Array, half: float) -> tuple[Array, Array]:
    """Distance and normal where the ends are nearer than the side, or the rim is nearest."""
    axial = np.zeros_like(radial)
    axial[:, 2] = np.where(z < 0, -1.0, 1.0)
    end = np.abs(z) - half
    distance, normal = np.maximum(side, end), np.where((end > side)[:, None], axial, radial)
    rim = np.flatnonzero((side > 0) & (end > 0))
    distance[rim] = np.hypot(side[rim], end[rim])
    parts = side[rim, None] * radial[rim] + end[rim, None] * axial[rim]
    normal[rim] = parts / distance[rim, None]
    return distance, normal
