"""A box with rounded edges."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tactile_base.settings import SettingError, Settings, setting
from tactile_scene import _native
from tactile_scene.shapes.surface import Array, Surface, rounded_grid

_QUADRANTS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


@dataclass(frozen=True)
class BoxSettings(Settings):
    """A box; the default is a Rubik's cube."""

    size: tuple[float, ...] = setting(
        (0.057, 0.057, 0.057), unit="m", lower=1e-3, upper=10.0, length=3, doc="extent along x, y and z"
    )
    rounding: float = setting(0.002, unit="m", lower=0.0, upper=5.0, doc="radius of edges and corners")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rounding > min(self.size) / 2:
            raise SettingError(
                f"rounding = {self.rounding:g} m: must be at most half the shortest side, "
                f"{min(self.size) / 2:g} m"
            )


class Box(Surface):
    """A box about the origin: all points within `rounding` of a smaller box, the core, with sharp edges."""

    settings_class = BoxSettings
    settings: BoxSettings

    @cached_property
    def _core(self) -> list[float]:
        """Half the core's size (3,), m."""
        return [size / 2 - self.settings.rounding for size in self.settings.size]

    def query(self, points: Array) -> tuple[Array, Array]:
        x, y, z = self._core
        return _native.box_query(points, x, y, z, self.settings.rounding)

    def grid(self, n: int = 60) -> Array:
        """A grid on a sphere, cut into eight and moved to the core's corners: faces are what lies between."""
        s, count = self.settings, max(2, n // 4)
        azimuth = np.arange(4)[:, None] * np.pi / 2 + np.linspace(0.0, np.pi / 2, count)
        return rounded_grid(azimuth, _QUADRANTS * self._core[:2], s.size[2] / 2, s.rounding, count)
