"""A bowl, and a motion that swings a body up and down."""

from dataclasses import dataclass

import numpy as np

from tactile_base.settings import Settings, setting
from tactile_scene.shapes.surface import Surface


@dataclass(frozen=True)
class BowlSettings(Settings):
    """A hollow ball about the origin, touched from within."""

    radius: float = setting(0.2, unit="m", lower=0.05, upper=10.0, doc="inner radius")


class Bowl(Surface):
    """The lower half is drawn."""

    settings_class = BowlSettings

    def query(self, points):
        """Distance to the wall (N,), and the normal into the bowl (N, 3)."""
        from_center = np.maximum(np.linalg.norm(points, axis=1), 1e-12)
        return self.settings.radius - from_center, -points / from_center[:, None]

    def grid(self, n=60):
        """Points of the lower half (n, n, 3)."""
        around, down = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, n), np.linspace(0.5 * np.pi, np.pi, n))
        unit = np.stack([np.sin(down) * np.cos(around), np.sin(down) * np.sin(around), np.cos(down)], axis=-1)
        return self.settings.radius * unit


@dataclass(frozen=True)
class SwingSettings(Settings):
    """How far and how fast."""

    height: float = setting(0.005, unit="m", lower=0.0, upper=0.1, doc="amplitude along the world's z")
    period: float = setting(4.0, unit="s", lower=0.1, upper=100.0, doc="of one swing")
    wait: float = setting(
        3.0, unit="s", lower=0.0, upper=100.0, doc="from the first touch to the first swing"
    )


class Swing:
    """Up and down from where the scene puts the body, after it has been touched."""

    settings_class = SwingSettings
    carriers = ()

    def __init__(self, scene, body, settings):
        self._start, self._settings, self._time = scene.T_world_body(body.name), settings, 0.0

    def step(self, dt, tools, contacts):
        """T_world_body (4, 4) after dt; `contacts` says who touches it, where, and how hard."""
        if contacts or self._time:
            self._time += dt
        swung = max(0.0, self._time - self._settings.wait) / self._settings.period
        T = self._start.copy()
        T[2, 3] += self._settings.height * np.sin(2.0 * np.pi * swung)
        return T
