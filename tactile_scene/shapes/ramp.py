"""A curved ramp."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings, setting
from tactile_scene.shapes.surface import Array, Surface

_NEWTON_TOLERANCE = 1e-8  # m, the last step: convergence is quadratic, so that the error left is below 1e-14
_NEWTON_LIMIT = 8
_BISECTIONS = 60
_MAX_SLOPE_DEG = 60.0


@dataclass(frozen=True)
class RampSettings(Settings):
    """A curved ramp: high flat part, S-shaped slope down along +y, low flat part."""

    height: float = setting(
        0.03, unit="m", lower=0.0, upper=1.0, doc="height of the high part over the low part"
    )
    length: float = setting(0.14, unit="m", lower=0.01, upper=10.0, doc="length of the slope along y")
    flat: float = setting(
        0.04, unit="m", lower=0.0, upper=10.0, doc="drawn length of each flat part (they have no end)"
    )
    width: float = setting(
        0.08, unit="m", lower=0.0, upper=10.0, doc="drawn width along x (the ramp has no side)"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        slope_deg = np.degrees(np.arctan(1.875 * self.height / self.length))
        if slope_deg > _MAX_SLOPE_DEG:
            raise SettingError(
                f"height = {self.height:g} m over length = {self.length:g} m: "
                f"slopes up to {slope_deg:.1f} degrees, must be at most {_MAX_SLOPE_DEG:g}"
            )


class Ramp(Surface):
    """A profile z = h(y) without end along x: h = height for y <= 0, 0 for y >= length, a quintic between.

    The quintic smoothstep makes the profile twice continuously differentiable, so that an arm that follows it
    sees no jump in angular velocity. The nearest point is found by Newton's method on the profile.
    """

    settings_class = RampSettings
    settings: RampSettings

    def profile(self, y: Array) -> tuple[Array, Array, Array]:
        """Height h(y) in m, slope h'(y) and h''(y) in 1/m, each of the shape of `y` (m)."""
        height, length = self.settings.height, self.settings.length
        t = np.clip(y / length, 0.0, 1.0)
        rest = 1.0 - t
        bump = t * rest
        h = height * (1.0 - t * t * t * (10.0 + t * (6.0 * t - 15.0)))
        slope = (-30.0 * height / length) * (bump * bump)
        second = (-60.0 * height / length**2) * (bump * (rest - t))
        return h, slope, second

    def query(self, points: Array) -> tuple[Array, Array]:
        y, z = points[:, 1], points[:, 2]
        u = self._nearest_on_profile(y, z)
        h, slope, _ = self.profile(u)
        scale = 1.0 / np.sqrt(1.0 + slope * slope)
        normal = np.zeros((len(points), 3))
        normal[:, 1] = -slope * scale
        normal[:, 2] = scale
        return (y - u) * normal[:, 1] + (z - h) * normal[:, 2], normal

    def grid(self, n: int = 60) -> Array:
        s = self.settings
        y = np.linspace(-s.flat, s.length + s.flat, 2 * n)
        x = np.linspace(-s.width / 2, s.width / 2, n)
        xx, yy = np.meshgrid(x, y)
        return np.stack([xx, yy, self.profile(yy)[0]], axis=-1)

    def _nearest_on_profile(self, y: Array, z: Array) -> Array:
        """Parameters u (N,) of the nearest points (u, h(u)) to (y, z)."""
        u, gap, converged = self._newton(y, z)
        # Well within the smallest radius of curvature the condition rises with u: its root is unique.
        most_bent = (
            10.0 / np.sqrt(3.0) * self.settings.height / self.settings.length**2
        )  # largest h''(y), 1/m
        search = ~converged | (gap * most_bent > 0.7)
        if search.any():
            u[search] = self._search(y[search], z[search])
        return u

    def _newton(self, y: Array, z: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Stationary points from u = y, the gaps |z - h(y)| there, and which ones converged."""
        h, slope, second = self.profile(y)
        first_gap = np.abs(z - h)
        u = y
        for _ in range(_NEWTON_LIMIT):
            gap = h - z
            step = (u - y + gap * slope) / np.maximum(1.0 + slope * slope + gap * second, 0.1)
            u = u - step
            moved = np.abs(step)
            if (moved < _NEWTON_TOLERANCE).all():
                break
            h, slope, second = self.profile(u)
        return u, first_gap, moved < _NEWTON_TOLERANCE

    def _search(self, y: Array, z: Array) -> Array:
        """Global minimum: nearest of many samples of the slope, then bisection of the condition."""
        length = self.settings.length
        samples = np.linspace(0.0, length, 129)
        h = self.profile(samples)[0]
        best = np.argmin((y[:, None] - samples) ** 2 + (z[:, None] - h) ** 2, axis=1)
        low = samples[np.maximum(best - 1, 0)]
        high = samples[np.minimum(best + 1, len(samples) - 1)]
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            h_middle, slope, _ = self.profile(middle)
            rising = middle - y + (h_middle - z) * slope > 0
            low, high = np.where(rising, low, middle), np.where(rising, middle, high)
        candidates = np.stack([np.minimum(y, 0.0), 0.5 * (low + high), np.maximum(y, length)])
        squared = (candidates - y) ** 2 + (self.profile(candidates)[0] - z) ** 2
        return np.take_along_axis(candidates, np.argmin(squared, axis=0)[None], axis=0)[0]
