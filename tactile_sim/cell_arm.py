"""An arm of the simulated cell with its sensor: what it touches, and where it is stopped."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tactile_geometry import se3
from tactile_scene import _native
from tactile_scene.arm import ArmMode
from tactile_scene.scene import ArmScene, Scene
from tactile_sim.arm import SimArm
from tactile_sim.body import Body, TouchedBody
from tactile_sim.frame import Frame, Truth
from tactile_sim.late_frames import LateFrames
from tactile_sim.motions import BodyContact
from tactile_sim.sensor import Sensor, contact_on_body, true_contact

if TYPE_CHECKING:
    from tactile_sim.network_view import ViewSettings

Array = NDArray[np.float64]


def sim_arm(scene: Scene, arm: ArmScene, stamp_ns: int) -> SimArm:
    try:
        return SimArm(arm.limits, arm.T_base_start, stamp_ns, arm.kinematics)
    except ValueError as error:
        raise ValueError(
            f"scene {scene.name}, arm '{arm.name}': its start is {error}; see its base, start, "
            "sensor.in_tool and kinematics.tool"
        ) from error


class CellArm:
    """An arm with what it carries and what it can touch."""

    def __init__(
        self,
        scene: Scene,
        arm: ArmScene,
        bodies: Mapping[str, Body],
        seed: int,
        moved: SimArm,
        view: ViewSettings | None,
    ) -> None:
        self.name, self.arm = arm.name, moved
        self.sensor: Sensor | None = None
        self.contact: BodyContact | None = None
        self._T_world_base = arm.T_world_base
        self._T_controlled_tool = se3.inverse(arm.T_tool_controlled)
        self._targets: list[TouchedBody] = []
        self._touched: TouchedBody | None = None
        self._sequence = 0
        self._moved, self._rate = 0.0, scene.simulation.rate
        self._T_said_sensor: Array | None = None
        self._late: LateFrames | None = None
        if arm.sensor is not None and arm.simulated_sensor:
            sensor = scene.simulation.sensors[arm.name]
            if sensor.at_input and view is None:
                raise ValueError(
                    f"arm '{arm.name}': a sensor of fidelity '{sensor.fidelity}' draws for a network that is "
                    "known beforehand, which `tactile simulate` does; with nodes choose 'image'"
                )
            self.sensor = Sensor(sensor, seed, view)
            if sensor.in_tool:
                self._T_said_sensor = scene.T_controlled_sensor(arm.name)
            self._ticks_per_frame = round(scene.simulation.rate / arm.sensor.settings.camera_rate)
            self._protective_depth = arm.sensor.settings.protective_depth
            touchable = [bodies[name] for name in scene.bodies_of(arm.name)]
            self._targets = [TouchedBody(body, arm.T_world_base) for body in touchable]
            shift = arm.sensor.settings.time_offset
            if sensor.delay or shift:
                self._late = LateFrames(sensor.delay, shift, self._rate)
                self._late.see(self.arm)

    @property
    def T_world_tool(self) -> Array:
        """The tool (4, 4) in the world."""
        T_world_controlled = se3.compose(self._T_world_base, self.arm.T_base_controlled)
        return se3.compose(T_world_controlled, self._T_controlled_tool)

    @property
    def T_base_tip(self) -> Array:
        """The sensor (4, 4) in the arm's base, where it really is."""
        T_base_said = self.arm.T_base_controlled
        return T_base_said if self._T_said_sensor is None else T_base_said @ self._T_said_sensor

    @property
    def touched(self) -> Body | None:
        """The body that the sensor touched at its last exposure."""
        return self._touched.body if self._touched is not None else None

    def step(self, stamp_ns: int) -> None:
        before = self.T_base_tip
        self.arm.advance_to(stamp_ns)
        self._moved = _native.distance(self.T_base_tip, before)
        if self._late is not None:
            self._late.see(self.arm)

    def protect(self, arms: Mapping[str, CellArm]) -> None:
        """Fault this arm if it came too deep into a body, braking now, and those that press it there."""
        if self.sensor is None:
            return
        T_base_sensor, limit = self.T_base_tip, self._protective_depth
        for target in self._targets:
            depth = target.depth_if_near(T_base_sensor, self._moved, self.sensor.radius, limit, self._brakes)
            if depth is None:
                continue
            center, normal, by_body = target.facing(T_base_sensor)
            by_sensor = -min(float(normal @ v) for v in self.velocities(center))
            if by_sensor + by_body <= 0.0:
                continue  # the way out is never barred
            carriers = [arms[name] for name in target.body.motion.carriers if name in arms]
            carried = max(
                (float(normal @ v) for arm in carriers for v in arm.velocities(center)), default=0.0
            )
            closing = by_sensor + min(by_body, carried)  # no arm can brake a body that falls
            if depth + self._braking_distance(max(closing, 0.0)) <= limit:
                continue
            culprits = [self] if by_sensor > 0.0 else []
            if by_body > 0.0:
                culprits += carriers
            for culprit in culprits:
                culprit.fault(
                    f"protective stop: {1e3 * depth:.1f} mm deep in '{target.body.name}', "
                    f"{1e3 * closing:.0f} mm/s into it (limit {1e3 * limit:g} mm)"
                )

    def depth(self) -> float:
        """Of the undeformed tip in the surface that it is deepest in, m; -inf without any."""
        if self.sensor is None:
            return -math.inf
        nearest = min((target.distance(self.T_base_tip) for target in self._targets), default=math.inf)
        return self.sensor.radius - nearest

    def velocities(self, point: Array) -> list[Array]:
        """Of a point (3,) of the world that goes along with the arm, in it: now, and as commanded."""
        T = self._T_world_base @ self.arm.T_base_controlled
        R, arm = T[:3, :3], T[:3, :3].T @ (point - T[:3, 3])
        return [R @ (twist[:3] + np.cross(twist[3:], arm)) for twist in (self.arm.twist, self.arm.target)]

    def _brakes(self, moved: float) -> float:
        return self._braking_distance(moved * self._rate + _native.speed(self.arm.target))

    def _braking_distance(self, speed: float) -> float:
        """Way (m) from a speed to rest; the next look is a step from now."""
        return self.arm.limits.braking_distance(speed, 1.0 / self._rate)

    def fault(self, reason: str) -> None:
        """Stop the arm, unless it is in fault already."""
        if self.arm.mode is not ArmMode.FAULT:
            self.arm.fault(reason)

    def exposure_due(self, ticks: int) -> bool:
        if self.sensor is None:
            return False
        if self._late is not None:
            return self._late.due(ticks, self._ticks_per_frame)
        return ticks % self._ticks_per_frame == 0

    def expose_late(self, ticks: int) -> None:
        """Make an exposure whose frame comes later, if it is time for one."""
        if self._late is not None and ticks % self._ticks_per_frame == 0:
            self._late.frames.append((ticks, self._exposed()))

    def expose(self, ticks: int) -> Frame:
        return self._exposed() if self._late is None else self._late.take(ticks)

    def _exposed(self) -> Frame:
        if self.sensor is None:
            raise ValueError(f"arm '{self.name}' has no sensor that is simulated in this scene")
        T_base_sensor = self.T_base_tip
        target, stamp_ns = self._nearest(T_base_sensor), self.arm.stamp_ns
        self.contact = None
        if target is None:
            truth = Truth.nothing()
        else:
            T_body_sensor = target.sensor_in_body(T_base_sensor)
            self.sensor.model.advance(target.body.surface, T_body_sensor)
            known = self.sensor.model.truth()
            geometry = self.sensor.geometry(target.body.surface, T_body_sensor)
            truth = true_contact(target, geometry, known)
            if truth.in_contact:
                self.contact = contact_on_body(self.name, stamp_ns, geometry, T_body_sensor, truth, known)
        self._touched = target if truth.in_contact else None
        image, estimate, plain_depth = self.sensor.answer(truth.in_contact)
        sequence, self._sequence = self._sequence, self._sequence + 1
        T_base_said = self.arm.T_base_controlled
        return Frame(self.name, stamp_ns, sequence, image, estimate, truth, T_base_said, plain_depth)

    def _nearest(self, T_base_sensor: Array) -> TouchedBody | None:
        """The body that the sensor touches, as long as it does, else the nearest to its centre."""
        if self._touched is not None or len(self._targets) == 1:
            return self._touched or self._targets[0]
        return min(self._targets, key=lambda target: target.distance(T_base_sensor), default=None)
