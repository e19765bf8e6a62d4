"""A cylinder, with flat ends or without end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_base.settings import Settings, setting
from tactile_scene import _native
from tactile_scene.shapes.surface import Array, Surface

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
        s = self.settings
        return _native.cylinder_query(points, s.radius, s.height / 2, s.ends, self._turn)

    def grid(self, n: int = 60) -> Array:
        s = self.settings
        azimuth = np.linspace(0.0, 2 * np.pi, n)
        circle = s.radius * np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(n)])
        end = np.array([0.0, 0.0, s.height / 2])
        rows = [circle - end, circle + end]
        if s.ends:
            rows = [np.tile(-end, (n, 1)), *rows, np.tile(end, (n, 1))]
        return np.roll(np.stack(rows), self._turn, axis=-1)
