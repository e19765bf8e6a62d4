"""A prism that stands on a regular polygon, with rounded edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_base.settings import SettingError, Settings, setting
from tactile_scene import _native
from tactile_scene.shapes.surface import Array, Surface, rounded_grid


@dataclass(frozen=True)
class PrismSettings(Settings):
    """A prism about the origin, along z; one of its sides faces y."""

    sides: int = setting(6, lower=3, upper=64, doc="number of equal sides")
    width: float = setting(
        0.08, unit="m", lower=2e-3, upper=10.0, doc="twice the distance of a side from the middle"
    )
    height: float = setting(0.08, unit="m", lower=1e-3, upper=10.0, doc="from end to end along z")
    rounding: float = setting(0.002, unit="m", lower=0.0, upper=5.0, doc="radius of edges and corners")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rounding > min(self.width, self.height) / 2:
            raise SettingError(
                f"rounding = {self.rounding:g} m: must be at most half of width and height, "
                f"{min(self.width, self.height) / 2:g} m"
            )


class Prism(Surface):
    """All points within `rounding` of a smaller prism, the core, with sharp edges."""

    settings_class = PrismSettings
    settings: PrismSettings

    def query(self, points: Array) -> tuple[Array, Array]:
        s = self.settings
        inner, height = s.width / 2 - s.rounding, s.height / 2 - s.rounding
        return _native.prism_query(points, s.sides, inner, height, s.rounding)

    def grid(self, n: int = 60) -> Array:
        """A grid on a sphere, cut at the corners of the core and moved there: sides are what lies between."""
        s, sector = self.settings, 2 * np.pi / self.settings.sides
        count = max(2, n // s.sides)
        corner = np.pi / 2 + sector * (np.arange(s.sides) + 0.5)
        azimuth = corner[:, None] + np.linspace(-sector / 2, sector / 2, count)
        reach = (s.width / 2 - s.rounding) / np.cos(sector / 2)
        corners = reach * np.stack([np.cos(corner), np.sin(corner)], axis=1)
        return rounded_grid(azimuth, corners, s.height / 2, s.rounding, max(2, n // 4))
