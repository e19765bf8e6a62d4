"""A circle over any surface, which ends where it began; a torus to draw it on, and a motion that turns it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from tactile_base.settings import Settings, setting
from tactile_control.contact_phases import INTO_CONTACT
from tactile_control.contact_task import ContactTask, ContactTaskSettings
from tactile_control.phases import DONE, FAILED, RETREAT, STOPPING, Goal
from tactile_geometry import se3
from tactile_scene.shapes.surface import Surface


@dataclass(frozen=True)
class CircleSettings(Settings):
    """How it is gone along."""

    speed: float = setting(0.010, lower=0.0, upper=0.2, unit="m/s", doc="along the circle")
    gain: float = setting(2.0, lower=0.0, upper=50.0, unit="1/s", doc="speed per distance from it")


@dataclass(frozen=True)
class CircleTaskSettings(ContactTaskSettings):
    """All settings of the control chain, and ours."""

    task: CircleSettings = field(default_factory=CircleSettings)


@dataclass(frozen=True)
class CircleGoal(Goal):
    """Which circle, as seen along the normal of the surface where it begins."""

    radius: float = setting(0.015, lower=1e-3, upper=0.5, unit="m", doc="of the circle")


class Circle(ContactTask):
    """Once round, by the place of the sensor in the base: from (0, 0), with the centre at (0, radius)."""

    settings_class = CircleTaskSettings
    goal_class = CircleGoal
    work = "circle"
    phases = (*INTO_CONTACT, "circle", STOPPING, RETREAT, DONE, FAILED)
    turned = 0.0  # rad, of the way from the centre to the sensor
    angle = -0.5 * math.pi

    def reference_velocity(self, elapsed):
        """Along the circle, and towards it."""
        from_centre = self.place[:2] - [0.0, self.goal.radius]
        distance = np.linalg.norm(from_centre)
        outward = from_centre / distance
        along = np.array([-outward[1], outward[0]])
        settings = self.settings.task
        return self.along_surface(
            settings.speed * along - settings.gain * (distance - self.goal.radius) * outward
        )

    def finished(self, elapsed):
        """Once round."""
        x, y, _ = self.place
        angle = math.atan2(y - self.goal.radius, x)
        self.turned += math.remainder(angle - self.angle, 2.0 * math.pi)
        self.angle = angle
        return self.turned >= 2.0 * math.pi

    def fraction(self):
        return min(1.0, max(0.0, self.turned / (2.0 * math.pi)))


@dataclass(frozen=True)
class TorusSettings(Settings):
    """A ring about the z-axis."""

    ring: float = setting(0.080, unit="m", lower=0.01, upper=10.0, doc="radius of the circle in its middle")
    tube: float = setting(
        0.050, unit="m", lower=0.005, upper=10.0, doc="radius of the tube about that circle"
    )


class Torus(Surface):
    """Curved one way outside, both ways inside."""

    settings_class = TorusSettings

    def query(self, points):
        """Distance (N,) and normal (N, 3), from the nearest point of the circle in its middle."""
        from_axis = np.maximum(np.linalg.norm(points[:, :2], axis=1), 1e-12)[:, None]
        middle = np.column_stack([self.settings.ring * points[:, :2] / from_axis, np.zeros(len(points))])
        away = points - middle
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-12)
        return distance - self.settings.tube, away / distance[:, None]

    def grid(self, n=60):
        """The whole of it (n, n, 3)."""
        along, around = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, n), np.linspace(0.0, 2.0 * np.pi, n))
        from_axis = self.settings.ring + self.settings.tube * np.cos(around)
        x, y = from_axis * np.cos(along), from_axis * np.sin(along)
        return np.stack([x, y, self.settings.tube * np.sin(around)], axis=-1)


@dataclass(frozen=True)
class TurningSettings(Settings):
    """How fast."""

    rate: float = setting(0.05, unit="rad/s", lower=-10.0, upper=10.0, doc="about the z-axis of the body")


class Turning:
    """Turns on the spot, and drags along what touches it."""

    settings_class = TurningSettings
    carriers = ()

    def __init__(self, scene, body, settings):
        self._T, self._rate = scene.T_world_body(body.name), settings.rate

    def step(self, dt, tools, contacts):
        """T_world_body (4, 4) after dt."""
        self._T = self._T @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, self._rate * dt]))
        return self._T.copy()
