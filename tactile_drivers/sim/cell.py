"""Cell: the simulated arms, sensors and bodies of a scene on one fixed time base, deterministic by seed.

Nothing in it waits: whoever owns the time calls `step`, a loop as fast as it can, a node as the clock says::

    cell = Cell(load_scene("ramp"), seed=1)
    while True:
        cell.step()                                    # 1 / scene.simulation.rate seconds
        if cell.exposure_due("arm"):
            frame = cell.expose("arm")                 # image, true contact, pose, all at one stamp
        cell.command("arm", cell.stamp_ns, twist)      # [v, omega] of the sensor, in the sensor frame
"""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import unknown_name
from tactile_base.stamps import SECOND_NS
from tactile_drivers import _native
from tactile_drivers.arm import ArmMode, ArmState
from tactile_drivers.scene import SIM, ArmScene, BodyScene, Scene
from tactile_drivers.shapes.surface import ContactGeometry, Surface, contact_pose
from tactile_drivers.sim.arm import SimArm
from tactile_drivers.sim.fitted_sensor import FittedSensor
from tactile_drivers.sim.ideal_sensor import IdealSensor, IdealTruth
from tactile_drivers.sim.motions import FIXED, BodyContact, Motion, make_motion
from tactile_drivers.sim.settings import FittedSensorSettings, SkinSettings, TacTipSettings
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian
from tactile_geometry.transform_buffer import TransformBuffer

if TYPE_CHECKING:
    from tactile_drivers.sim.network_view import ViewSettings
    from tactile_drivers.sim.simulation import SimulatedSensor
    from tactile_drivers.sim.skin import Skin
    from tactile_drivers.sim.tactip import ContactTruth, TacTip

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Truth:
    """The contact of one sensor at one stamp; without a surface, `surface` is empty and the rest NaN.

    Attributes
    ----------
    surface : str
        Name of the surface that is meant, the nearest.
    in_contact : bool
        Whether the undeformed tip reaches below the surface.
    depth : float
        Depth of the undeformed tip below the surface, m; negative off it.
    normal_angle : float
        Angle between the sensor's z axis and the surface's inward normal at the nearest point, rad.
    T_fs : ndarray (4, 4)
        Equivalent surface contact pose X_fs.
    slip_fraction : float
        How much of the contact slips, 0..1.
    normal_force : float
        Force of the surface on the sensor along the outward normal, N; NaN where it is not modelled.
    nearest, outward : ndarray (3,)
        Nearest point of the true surface (m) and the outward unit normal there, in its body's frame.
    T_base_body : ndarray (4, 4)
        That body in the arm's base.
    """

    surface: str
    in_contact: bool
    depth: float
    normal_angle: float
    T_fs: Array
    slip_fraction: float
    normal_force: float
    nearest: Array
    outward: Array
    T_base_body: Array

    @property
    def point(self) -> Array:
        """The nearest point (3,) in the arm's base, m."""
        return np.asarray(self.T_base_body[:3, :3] @ self.nearest + self.T_base_body[:3, 3])

    @property
    def normal(self) -> Array:
        """The normal (3,) there in the arm's base."""
        return np.asarray(self.T_base_body[:3, :3] @ self.outward)

    @property
    def shear(self) -> Array:
        """Its shear (3,): x, y (m) and turn gamma (rad) of X_fs as extrinsic xyz Euler angles."""
        T_fs = self.T_fs
        return np.array([T_fs[0, 3], T_fs[1, 3], np.arctan2(T_fs[1, 0], T_fs[0, 0])])

    @classmethod
    def nothing(cls) -> Truth:
        """The truth of a sensor that no surface is there for."""
        nan = float("nan")
        missing, missing_pose = np.full(3, nan), np.full((4, 4), nan)
        return cls("", False, nan, nan, missing_pose, 0.0, 0.0, missing, missing, missing_pose)


@dataclass(frozen=True)
class Frame:
    """One exposure of one sensor.

    Attributes
    ----------
    sequence : int
        Number of the exposure, from 0.
    image : ndarray (480, 640) uint8, or (size, size) with a view of a network, or None
        None for a sensor that gives estimates.
    estimate : PoseGaussian or None
        X_sf from a sensor of fidelity "fitted" or "ideal" in contact; else None.
    truth : Truth
    T_base_sensor : ndarray (4, 4)
        Where the arm says that the sensor was at the stamp.
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
    views : mapping, optional
        Arm -> the network whose input its sensor gives, for sensors of fidelity "input".
    followed : mapping
        Arm -> what stands for it, for arms that something else moves.

    Raises
    ------
    ValueError
        If the scene has no simulated arm, what it says of a body's motion is wrong, or an arm with known
        kinematics cannot reach its start.
    """

    def __init__(
        self,
        scene: Scene,
        seed: int = 0,
        stamp_ns: int = 0,
        views: Mapping[str, ViewSettings] | None = None,
        followed: Mapping[str, SimArm] | None = None,
    ) -> None:
        self.scene = scene
        followed = followed or {}
        self._rate = scene.simulation.rate
        self._start_ns, self._ticks = int(stamp_ns), 0
        simulated = [arm for name, arm in scene.arms.items() if arm.driver == SIM or name in followed]
        if not simulated:
            raise ValueError(f"scene {scene.name}: none of its arms has the driver '{SIM}'")
        self._bodies = {name: _Body(scene, body) for name, body in scene.bodies.items()}
        self._moving = [body for body in self._bodies.values() if not body.fixed]
        seeds = np.random.SeedSequence(seed).generate_state(len(simulated))
        self._arms = {
            arm.name: _CellArm(
                scene,
                arm,
                self._bodies,
                int(arm_seed),
                followed.get(arm.name) or _sim_arm(scene, arm, self._start_ns),
                (views or {}).get(arm.name),
            )
            for arm, arm_seed in zip(simulated, seeds, strict=True)
        }
        self._tools = {  # of arms that are not simulated: where they start
            name: arm.T_world_start @ se3.inverse(arm.T_tool_controlled) for name, arm in scene.arms.items()
        }

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of the simulated arms."""
        return tuple(self._arms)

    @property
    def stamp_ns(self) -> int:
        """Time of the cell, ns: the start plus a whole number of steps, without drift."""
        return self._start_ns + (self._ticks * SECOND_NS) // self._rate

    def step(self, steps: int = 1) -> int:
        """Move arms and bodies on by that many steps of the simulation and return the stamp."""
        for _ in range(steps):
            self._ticks += 1
            for arm in self._arms.values():
                arm.step(self.stamp_ns)
            if self._moving:
                self._move_bodies()
            for arm in self._arms.values():
                arm.protect(self._arms)
                arm.expose_late(self._ticks)
        return self.stamp_ns

    def arm(self, arm: str) -> SimArm:
        """The simulated arm: an `Arm` whose states the cell's steps make."""
        return self._arm(arm).arm

    def command(self, arm: str, stamp_ns: int, twist: ArrayLike) -> None:
        """Command a twist (6,), emitted at `stamp_ns`, past the safe command stage."""
        self._arm(arm).arm.command(stamp_ns, twist)

    def status(self, arm: str) -> ArmState:
        """Where the arm is, what it does, and why."""
        return self._arm(arm).arm.state

    def T_base_sensor(self, arm: str) -> Array:
        """Pose (4, 4) of the arm's sensor (of the tool, for an arm without one) in its base, now."""
        return self._arm(arm).arm.T_base_controlled

    def T_world_body(self, body: str) -> Array:
        """Pose (4, 4) of a body in the world, now."""
        if body not in self._bodies:
            raise KeyError(unknown_name(body, list(self._bodies)))
        return self._bodies[body].T_world_body.copy()

    def motion(self, body: str) -> Motion:
        """The motion of a body, with the state that its model has."""
        if body not in self._bodies:
            raise KeyError(unknown_name(body, list(self._bodies)))
        return self._bodies[body].motion

    def depth(self, arm: str) -> float:
        """Depth (m) of the undeformed tip in the surface that it is deepest in, now; -inf without any."""
        return self._arm(arm).depth()

    def exposure_due(self, arm: str) -> bool:
        """Whether the camera of the arm's sensor exposes at the present step."""
        return self._arm(arm).exposure_due(self._ticks)

    def expose(self, arm: str) -> Frame:
        """Expose the arm's sensor now.

        The skin moves on from where it was at the last exposure; image and noise differ each time.

        Raises
        ------
        ValueError
            If the arm has no simulated sensor.
        """
        return self._arm(arm).expose(self._ticks)

    def _arm(self, name: str) -> _CellArm:
        if name not in self._arms:
            raise KeyError(unknown_name(name, list(self._arms)))
        return self._arms[name]

    def _move_bodies(self) -> None:
        """Take each body that moves to where it is now that the arms are where they are."""
        for name, arm in self._arms.items():
            self._tools[name] = arm.T_world_tool
        for body in self._moving:
            contacts = [arm.contact for arm in self._arms.values() if arm.contact and arm.touched is body]
            body.move(1.0 / self._rate, self._tools, contacts)


class _Body:
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


class _Target:
    """A body as one sensor sees it."""

    def __init__(self, body: _Body, T_world_base: Array) -> None:
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
            moved = np.inf if self._before is None else _native.apart(T_body_sensor, self._before)
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


def _sim_arm(scene: Scene, arm: ArmScene, stamp_ns: int) -> SimArm:
    try:
        return SimArm(arm.limits, arm.T_base_start, stamp_ns, arm.kinematics)
    except ValueError as error:
        raise ValueError(
            f"scene {scene.name}, arm '{arm.name}': its start is {error}; see its base, start, "
            "sensor.in_tool and kinematics.tool"
        ) from error


class _CellArm:
    """An arm with what it carries and what it can touch."""

    def __init__(
        self,
        scene: Scene,
        arm: ArmScene,
        bodies: Mapping[str, _Body],
        seed: int,
        moved: SimArm,
        view: ViewSettings | None,
    ) -> None:
        self.name, self.arm = arm.name, moved
        self.sensor: _Sensor | None = None
        self.contact: BodyContact | None = None
        self._T_world_base = arm.T_world_base
        self._T_controlled_tool = se3.inverse(arm.T_tool_controlled)
        self._targets: list[_Target] = []
        self._touched: _Target | None = None
        self._sequence = 0
        self._moved, self._rate = 0.0, scene.simulation.rate
        self._T_said_sensor: Array | None = None
        self._late: _LateFrames | None = None
        if arm.sensor is not None and arm.simulated_sensor:
            sensor = scene.simulation.sensors[arm.name]
            if sensor.at_input and view is None:
                raise ValueError(
                    f"arm '{arm.name}': a sensor of fidelity '{sensor.fidelity}' draws for a network that is "
                    "known beforehand, which `tactile simulate` does; with nodes choose 'image'"
                )
            self.sensor = _Sensor(sensor, seed, view)
            if sensor.in_tool:
                T_tool_sensor = se3.pose_from_euler(sensor.in_tool)
                self._T_said_sensor = se3.inverse(arm.T_tool_controlled) @ T_tool_sensor
            self._ticks_per_frame = round(scene.simulation.rate / arm.sensor.settings.camera_rate)
            self._protective_depth = arm.sensor.settings.protective_depth
            self._targets = [_Target(bodies[name], arm.T_world_base) for name in scene.bodies_of(arm.name)]
            shift = arm.sensor.settings.time_offset
            if sensor.delay or shift:
                self._late = _LateFrames(sensor.delay, shift, self._rate)
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
    def touched(self) -> _Body | None:
        """The body that the sensor touched at its last exposure."""
        return self._touched.body if self._touched is not None else None

    def step(self, stamp_ns: int) -> None:
        before = self.T_base_tip
        self.arm.advance_to(stamp_ns)
        self._moved = _native.apart(self.T_base_tip, before)
        if self._late is not None:
            self._late.see(self.arm)

    def protect(self, arms: Mapping[str, _CellArm]) -> None:
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
        target = self._nearest(T_base_sensor)
        self.contact = None
        if target is None:
            truth = Truth.nothing()
        else:
            T_body_sensor = target.sensor_in_body(T_base_sensor)
            self.sensor.model.advance(target.body.surface, T_body_sensor)
            known = self.sensor.model.truth()
            geometry = self.sensor.geometry(target.body.surface, T_body_sensor)
            truth = _truth(target, geometry, known)
            if truth.in_contact:
                self.contact = _contact(self.name, self.arm.stamp_ns, geometry, T_body_sensor, truth, known)
        self._touched = target if truth.in_contact else None
        image, estimate = self.sensor.answer(truth.in_contact)
        sequence, self._sequence = self._sequence, self._sequence + 1
        T_base_said = self.arm.T_base_controlled
        return Frame(self.name, self.arm.stamp_ns, sequence, image, estimate, truth, T_base_said)

    def _nearest(self, T_base_sensor: Array) -> _Target | None:
        """The body that the sensor touches, as long as it does, else the nearest to its centre."""
        if self._touched is not None or len(self._targets) == 1:
            return self._touched or self._targets[0]
        return min(self._targets, key=lambda target: target.distance(T_base_sensor), default=None)


class _LateFrames:
    """Frames of a camera that are stamped when they come, and the scene's correction of these stamps.

    Parameters
    ----------
    delay : float
        From the exposure to the stamp, s.
    shift : float
        What the scene adds to the stamps, s; not above zero.
    rate : int
        Steps in a second.
    """

    def __init__(self, delay: float, shift: float, rate: int) -> None:
        self.frames: deque[tuple[int, Frame]] = deque()
        self._ticks = math.ceil(delay * rate - 1e-9)
        self._first = max(self._ticks, math.ceil(-shift * rate))  # before it, no pose is known at the stamp
        self._later_ns = round((delay + shift) * SECOND_NS)
        self._track = TransformBuffer(SECOND_NS)

    def see(self, arm: SimArm) -> None:
        """Remember where an arm says that the sensor is."""
        self._track.set_transform("base", "sensor", arm.stamp_ns, arm.T_base_controlled)

    def due(self, ticks: int, ticks_per_frame: int) -> bool:
        """Whether the frame of an exposure comes at this step."""
        exposed = ticks - self._ticks
        return ticks > self._first and exposed > 0 and exposed % ticks_per_frame == 0

    def take(self, ticks: int) -> Frame:
        """The frame that comes at this step; those before it that nobody took are lost."""
        while self.frames and self.frames[0][0] < ticks - self._ticks:
            self.frames.popleft()
        if not self.frames or self.frames[0][0] != ticks - self._ticks:
            raise ValueError("no frame comes at this step; see exposure_due")
        _, frame = self.frames.popleft()
        stamp_ns = frame.stamp_ns + self._later_ns
        T_base_sensor = self._track.lookup("base", "sensor", stamp_ns)
        return replace(frame, stamp_ns=stamp_ns, T_base_sensor=T_base_sensor)


class _Sensor:
    """A TacTip, whose answer is an image, or an ideal sensor, whose answer is an estimate."""

    def __init__(self, sensor: SimulatedSensor, seed: int, view: ViewSettings | None) -> None:
        self.radius = sensor.tip_radius
        self.model: TacTip | IdealSensor
        if isinstance(sensor.model, TacTipSettings):
            from tactile_drivers.sim.tactip import TacTip  # needs the compiled contact solver

            self.model = TacTip(sensor.model, seed, _skin(sensor.model.skin), view)
        elif isinstance(sensor.model, FittedSensorSettings):
            self.model = FittedSensor(sensor.model, seed)
        else:
            self.model = IdealSensor(sensor.model, seed)

    def geometry(self, surface: Surface, T_surface_sensor: Array) -> ContactGeometry:
        """Where the undeformed tip meets the surface, to which the model has advanced."""
        if isinstance(self.model, IdealSensor):
            return self.model.geometry
        return contact_pose(surface, T_surface_sensor, self.radius)

    def answer(self, in_contact: bool) -> tuple[NDArray[np.uint8] | None, PoseGaussian | None]:
        if isinstance(self.model, IdealSensor):
            return None, self.model.estimate() if in_contact else None
        return self.model.image(), None


@functools.cache
def _skin(settings: SkinSettings) -> Skin:
    """The condensed skin, which several sensors share; nothing writes to it."""
    from tactile_drivers.sim.skin import load_skin

    return load_skin(settings)


def _contact(
    arm: str,
    stamp_ns: int,
    geometry: ContactGeometry,
    T: Array,
    truth: Truth,
    known: ContactTruth | IdealTruth,
) -> BodyContact:
    """What the body feels of the sensor: the force acts at the nearest point, or, where it is modelled,
    where its line of action meets the surface's tangent plane there.
    """
    normal, point = geometry.normal, geometry.point
    if math.isnan(known.normal_force):  # which is not modelled
        return BodyContact(arm, stamp_ns, T, truth, known.force, point, normal)
    R = T[:3, :3]
    force, torque = -R @ known.force, -R @ known.torque
    press = -float(force @ normal)
    if press > 0:  # not without contact
        nearest = np.cross(force, torque) / float(force @ force) + T[:3, 3]
        point = nearest + float((nearest - point) @ normal) / press * force
    return BodyContact(arm, stamp_ns, T, truth, force, point, normal)


def _truth(target: _Target, geometry: ContactGeometry, known: ContactTruth | IdealTruth) -> Truth:
    """What the sensor's model knows, with the geometry of the surface in the arm's base."""
    return Truth(
        surface=target.body.name,
        in_contact=known.contact_nodes > 0,
        depth=geometry.depth,
        normal_angle=geometry.normal_angle,
        T_fs=known.T_fs,
        slip_fraction=known.slip_fraction,
        normal_force=known.normal_force,
        nearest=geometry.point,
        outward=geometry.normal,
        T_base_body=target.T_base_body,
    )
