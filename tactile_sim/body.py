"""Bodies of the simulated cell: where they are, and as a sensor meets them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from tactile_geometry import se3
from tactile_scene import _native
from tactile_scene.motions import FIXED
from tactile_scene.scene import BodyScene, Scene
from tactile_scene.shapes.surface import Surface
from tactile_sim.motions import BodyContact, make_motion

Array = NDArray[np.float64]


class Body:
    """A body where it is, and where it was a step ago."""

    def __init__(self, scene: Scene, body: BodyScene) -> None:
        self.name = body.name
        self.fixed = body.motion == FIXED
        self.surface: Surface = body.make()
        self.motion = make_motion(scene, body)
        self.T_world_body = self._before = scene.T_world_body(body.name)
        self._dt = 0.0

    def move(self, dt: float, tools: Mapping[str, Array], contacts: list[BodyContact]) -> None:
        self._before, self._dt = self.T_world_body, dt
        self.T_world_body = self.motion.step(dt, tools, contacts)

    def velocity_at(self, point: Array) -> Array:
        """Velocity (3,) in m/s of the body's matter at a point (3,) of its own frame, in the world."""
        if self.fixed or self._dt == 0.0:
            return np.zeros(3)
        moved = self.T_world_body - self._before
        return np.asarray(moved[:3, :3] @ point + moved[:3, 3]) / self._dt


class TouchedBody:
    """A body as one sensor sees it."""

    def __init__(self, body: Body, T_world_base: Array) -> None:
        self.body = body
        self._T_base_world = se3.inverse(T_world_base)
        self._T_base_fixed = self._T_base_world @ body.T_world_body
        self._slack = 0.0
        self._before: Array | None = None  # T_body_sensor of the last step

    @property
    def T_base_body(self) -> Array:
        """The body (4, 4) in the arm's base, now."""
        if self.body.fixed:
            return self._T_base_fixed
        return se3.compose(self._T_base_world, self.body.T_world_body)

    def sensor_in_body(self, T_base_sensor: Array) -> Array:
        return se3.between(self.T_base_body, T_base_sensor)

    def distance(self, T_base_sensor: Array) -> float:
        """Distance of the sensor's centre from the surface, m."""
        center = self.sensor_in_body(T_base_sensor)[:3, 3]
        return float(self.body.surface.distance(center[None])[0])

    def depth_if_near(
        self,
        T_base_sensor: Array,
        moved: float,
        radius: float,
        limit: float,
        brakes: Callable[[float], float],
    ) -> float | None:
        """Depth (m) of the tip; None while it cannot come as deep as the limit, braking now.

        No distance changes by more than the sensor moves in the body's frame: by `moved`, if that is fixed.
        `brakes` says how far an arm goes on (m), at most, that has moved that far (m) in this step.
        """
        if not self.body.fixed:
            T_body_sensor = self.sensor_in_body(T_base_sensor)
            moved = np.inf if self._before is None else _native.distance(T_body_sensor, self._before)
            self._before = T_body_sensor
        self._slack -= moved
        if self._slack > brakes(moved):
            return None
        depth = radius - self.distance(T_base_sensor)
        self._slack = limit - depth
        return depth

    def facing(self, T_base_sensor: Array) -> tuple[Array, Array, float]:
        """Sensor's centre and the surface's outward normal (3,), in the world; the body's speed along it."""
        center = self.sensor_in_body(T_base_sensor)[:3, 3]
        R, p = self.body.T_world_body[:3, :3], self.body.T_world_body[:3, 3]
        normal = R @ self.body.surface.normal(center[None])[0]
        return R @ center + p, normal, float(normal @ self.body.velocity_at(center))
