"""Cell: the simulated arms, sensors and surfaces of a scene on one fixed time base, deterministic by seed.

Nothing in it waits: whoever owns the time calls `step`, a loop as fast as it can, a node as the clock says::

    cell = Cell(load_scene("ramp"), seed=1)
    while True:
        cell.step()                                    # 1 / scene.rate seconds
        if cell.exposure_due("arm"):
            frame = cell.expose("arm")                 # image, true contact, pose, all at one stamp
        cell.command("arm", cell.stamp_ns, twist)      # [v, omega] of the sensor, in the sensor frame
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import unknown_name
from tactile_drivers.scene import ArmScene, Scene, SensorScene
from tactile_drivers.shapes.contact import contact_pose
from tactile_drivers.shapes.surface import Surface
from tactile_drivers.sim.arm import NS, ArmMode, ArmStatus, SimArm
from tactile_drivers.sim.ideal_sensor import IdealSensor, IdealSensorSettings
from tactile_drivers.sim.truth import Truth, shear_of
from tactile_filter import se3
from tactile_filter.gaussian import PoseGaussian

if TYPE_CHECKING:
    from tactile_drivers.sim.skin import Skin, SkinSettings
    from tactile_drivers.sim.tactip import TacTipSettings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """One exposure of one sensor.

    Attributes
    ----------
    sequence : int
        Number of the exposure, from 0.
    image : ndarray (480, 640) uint8 or None
        None for a sensor of fidelity "ideal".
    estimate : PoseGaussian or None
        X_sf from a sensor of fidelity "ideal" in contact; else None.
    truth : Truth
    T_base_sensor : ndarray (4, 4)
    """

    arm: str
    stamp_ns: int
    sequence: int
    image: NDArray[np.uint8] | None
    estimate: PoseGaussian | None
    truth: Truth
    T_base_sensor: Array


class Cell:
    """The simulated part of a scene.

    Parameters
    ----------
    scene : Scene
    seed : int
        Of all noise; the same seed and commands give the same bits.
    stamp_ns : int
        Time of the first state, ns.

    Raises
    ------
    ValueError
        If the scene has no simulated arm.
    """

    def __init__(self, scene: Scene, seed: int = 0, stamp_ns: int = 0) -> None:
        self.scene = scene
        self._start_ns, self._ticks = int(stamp_ns), 0
        surfaces = {name: surface.make() for name, surface in scene.surfaces.items()}
        simulated = [arm for arm in scene.arms.values() if arm.driver == "sim"]
        if not simulated:
            raise ValueError(f"scene {scene.name}: none of its arms has the driver 'sim'")
        seeds = np.random.SeedSequence(seed).generate_state(len(simulated))
        self._arms = {
            arm.name: _CellArm(scene, arm, surfaces, int(arm_seed), self._start_ns)
            for arm, arm_seed in zip(simulated, seeds, strict=True)
        }

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of the simulated arms."""
        return tuple(self._arms)

    @property
    def stamp_ns(self) -> int:
        """Time of the cell, ns: the start plus a whole number of steps, without drift."""
        return self._start_ns + (self._ticks * NS) // self.scene.rate

    def step(self, steps: int = 1) -> int:
        """Move all arms on by that many steps of 1 / scene.rate seconds and return the stamp."""
        for _ in range(steps):
            self._ticks += 1
            for arm in self._arms.values():
                arm.step(self.stamp_ns)
        return self.stamp_ns

    def command(self, arm: str, stamp_ns: int, twist: ArrayLike) -> bool:
        """Command a twist (6,), emitted at `stamp_ns`; False where refused (see `SimArm.command`)."""
        return self._arm(arm).arm.command(stamp_ns, twist)

    def status(self, arm: str) -> ArmStatus:
        """What the arm does, and why."""
        return self._arm(arm).arm.status

    def T_base_sensor(self, arm: str) -> Array:
        """Pose (4, 4) of the arm's sensor in its base, now."""
        return self._arm(arm).arm.T_base_sensor

    def exposure_due(self, arm: str) -> bool:
        """Whether the camera of the arm's sensor exposes at the present step."""
        return self._arm(arm).exposure_due(self._ticks)

    def expose(self, arm: str) -> Frame:
        """Expose the arm's sensor now.

        The skin moves on from where it was at the last exposure; image and noise differ each time.

        Raises
        ------
        ValueError
            If the arm has no sensor.
        """
        return self._arm(arm).expose()

    def clear_fault(self, arm: str) -> None:
        """Let an arm in fault accept commands again."""
        self._arm(arm).arm.clear_fault()

    def _arm(self, name: str) -> _CellArm:
        if name not in self._arms:
            raise KeyError(unknown_name(name, list(self._arms)))
        return self._arms[name]


@dataclass(frozen=True)
class _Target:
    """A surface where it stands, seen from one arm."""

    name: str
    surface: Surface
    T_base_surface: Array

    def sensor_in_surface(self, T_base_sensor: Array) -> Array:
        return se3.inverse(self.T_base_surface) @ T_base_sensor

    def distance(self, T_base_sensor: Array) -> float:
        """Distance of the sensor's centre from the surface, m."""
        center = self.sensor_in_surface(T_base_sensor)[:3, 3]
        return float(self.surface.distance(center[None])[0])


class _CellArm:
    """An arm with what it carries and what it can touch."""

    def __init__(
        self, scene: Scene, arm: ArmScene, surfaces: dict[str, Surface], seed: int, stamp_ns: int
    ) -> None:
        self.name = arm.name
        self.arm = SimArm(arm.limits, arm.T_base_start, stamp_ns)
        self.sensor = _make_sensor(arm.sensor, seed) if arm.sensor else None
        self._ticks_per_frame = round(scene.rate / arm.sensor.settings.camera_rate) if arm.sensor else 0
        self._protective_depth = arm.sensor.settings.protective_depth if arm.sensor else 0.0
        self._sequence = 0
        placed = {name: item.T_base_surface(arm) for name, item in scene.surfaces_of(arm.name).items()}
        self._targets = [_Target(name, surfaces[name], T) for name, T in placed.items()]
        self._touched: _Target | None = None
        self._slack = 0.0

    def step(self, stamp_ns: int) -> None:
        before = self.arm.T_base_sensor
        T_base_sensor = self.arm.advance_to(stamp_ns)
        # no distance changes by more than the sensor moves, so most steps need no look at the surfaces
        self._slack -= float(np.linalg.norm(T_base_sensor[:3, 3] - before[:3, 3]))
        if self._slack <= 0.0 and self.sensor is not None and self.arm.mode is not ArmMode.FAULT:
            self._protect(self.sensor.radius, T_base_sensor)

    def _protect(self, radius: float, T_base_sensor: Array) -> None:
        """Fault the arm if it presses too deep; note how far it may move before the next look."""
        self._slack = np.inf
        for target in self._targets:
            depth = radius - target.distance(T_base_sensor)
            self._slack = min(self._slack, self._protective_depth - depth)
            if depth > self._protective_depth and self._goes_deeper(target, T_base_sensor):
                limit = 1e3 * self._protective_depth
                self.arm.fault(
                    f"protective stop: {1e3 * depth:.1f} mm deep in '{target.name}' (limit {limit:g} mm)"
                )

    def exposure_due(self, ticks: int) -> bool:
        return self.sensor is not None and ticks % self._ticks_per_frame == 0

    def expose(self) -> Frame:
        if self.sensor is None:
            raise ValueError(f"arm '{self.name}' has no sensor in this scene")
        T_base_sensor = self.arm.T_base_sensor
        target = self._nearest(T_base_sensor)
        if target is None:
            truth = Truth.nothing()
        else:
            self.sensor.model.advance(target.surface, target.sensor_in_surface(T_base_sensor))
            truth = _truth(target, T_base_sensor, self.sensor)
        self._touched = target if truth.in_contact else None
        image, estimate = self.sensor.answer(truth.in_contact)
        sequence, self._sequence = self._sequence, self._sequence + 1
        return Frame(self.name, self.arm.stamp_ns, sequence, image, estimate, truth, T_base_sensor)

    def _nearest(self, T_base_sensor: Array) -> _Target | None:
        """The surface that the sensor touches, as long as it does, else the nearest to its centre."""
        if self._touched is not None or len(self._targets) == 1:
            return self._touched or self._targets[0]
        return min(self._targets, key=lambda target: target.distance(T_base_sensor), default=None)

    def _goes_deeper(self, target: _Target, T_base_sensor: Array) -> bool:
        """Whether the commanded motion goes on into the surface; the way out is never barred."""
        center = target.sensor_in_surface(T_base_sensor)[:3, 3]
        normal = target.T_base_surface[:3, :3] @ target.surface.normal(center[None])[0]
        return float(normal @ T_base_sensor[:3, :3] @ self.arm.target[:3]) < 0


class _ImageSensor:
    """A TacTip, whose answer is an image."""

    def __init__(self, settings: TacTipSettings, seed: int) -> None:
        from tactile_drivers.sim.tactip import TacTip  # needs the compiled contact solver

        self.model = TacTip(settings, seed, _skin(settings.skin))
        self.radius = settings.skin.radius

    def answer(self, in_contact: bool) -> tuple[NDArray[np.uint8] | None, PoseGaussian | None]:
        return self.model.image(), None


class _IdealAnswer:
    """An ideal sensor, whose answer is an estimate."""

    def __init__(self, settings: IdealSensorSettings, seed: int) -> None:
        self.model = IdealSensor(settings, seed)
        self.radius = settings.radius

    def answer(self, in_contact: bool) -> tuple[NDArray[np.uint8] | None, PoseGaussian | None]:
        return None, self.model.estimate() if in_contact else None


def _make_sensor(scene: SensorScene, seed: int) -> _ImageSensor | _IdealAnswer:
    kinds: dict[str, type[_ImageSensor] | type[_IdealAnswer]] = {"image": _ImageSensor, "ideal": _IdealAnswer}
    return kinds[scene.settings.fidelity](scene.model, seed)


@functools.cache
def _skin(settings: SkinSettings) -> Skin:
    """The condensed skin, which several sensors share; nothing writes to it."""
    from tactile_drivers.sim.skin import load_skin

    return load_skin(settings)


def _truth(target: _Target, T_base_sensor: Array, sensor: _ImageSensor | _IdealAnswer) -> Truth:
    """What the sensor's model knows, with the geometry of the surface in the arm's base."""
    known = sensor.model.truth()
    geometry = contact_pose(target.surface, target.sensor_in_surface(T_base_sensor), sensor.radius)
    rotation, origin = target.T_base_surface[:3, :3], target.T_base_surface[:3, 3]
    return Truth(
        surface=target.name,
        in_contact=known.contact_nodes > 0,
        depth=geometry.depth,
        normal_angle=geometry.normal_angle,
        T_fs=known.T_fs,
        shear=shear_of(known.T_fs),
        slip_fraction=known.slip_fraction,
        normal_force=known.normal_force,
        point=rotation @ geometry.point + origin,
        normal=rotation @ geometry.normal,
    )
