"""A cell in the plane: arms with ideal sensors that push one object each, many trials at once in arrays.

The fidelity `plane`: the arms, the ideal sensor and the pushed object of `Cell`, with motions in the plane of
the floor, up and down, and about the vertical alone. Noise is that of the ideal sensor of the trial's seed,
as far as it lies in the plane, to the bit. A direction of a sensor (N,) is a complex number, ahead + i left,
and its frame turns as seen from above; down is apart. `plane_body` has the objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tactile_base.array_math import ArrayMath
from tactile_base.settings import SettingError
from tactile_scene.scene import ArmScene, Scene
from tactile_scene.simulated_sensors import IdealSensorSettings
from tactile_sim.plane_body import PlaneBodies, Tips, dot
from tactile_sim.pushing_scene import MOTION
from tactile_sim.skin_force import REFERENCE_DEPTH

Array = Any  # of the library in use

PRESSED = 0.42  # of a tip's depth: as in _csrc/point_contact.c
TINY = 1e-12
BLOCK = 256  # exposures whose noise is drawn at once
#: Which of the six numbers of an estimate's noise stay in the plane: ahead (z), left (y), down (x), about x.
_IN_PLANE = (2, 1, 0, 3)


@dataclass
class Pose:
    """Of N sensors: place in the world and turn seen from above; height above the floor."""

    at: Array
    turn: Array
    height: Array

    def shifted(self, way: Array, turn: Array, math: ArrayMath) -> Pose:
        """Those that stand at a way (N,) in these, ahead + i left, and turned by so much."""
        return Pose(self.at + math.exp(1j * self.turn) * way, self.turn + turn, self.height)


@dataclass
class Seen:
    """What N exposures tell: X_sf in the plane, and what is true.

    Attributes
    ----------
    present : (N,) whether there is contact
    at, turn, down : the feature in the sensor as estimated: ahead + i left, m, its turn, rad, and down, m
    normal : true directions into the objects, in the world
    depth, shear : true, m; the shear over all directions
    slips : whether the tip slips
    pose : where the sensor was
    """

    present: Array
    at: Array
    turn: Array
    down: Array
    normal: Array
    depth: Array
    shear: Array
    slips: Array
    pose: Pose


class PlaneArm:
    """N arms that make the fastest motion that keeps acceleration and jerk, as `SimArm`."""

    def __init__(self, arms: Sequence[ArmScene], math: ArrayMath) -> None:
        starts = np.array([arm.T_world_start for arm in arms])
        if abs(starts[:, 2, :3] - [-1.0, 0.0, 0.0]).max() > 1e-9:
            raise SettingError(
                f"fidelity plane: arm '{arms[0].name}' has to start level, its sensor's x pointing down"
            )
        self._math, limits = math, arms[0].limits
        ahead = starts[:, 0, 2] + 1j * starts[:, 1, 2]
        place = starts[:, 0, 3] + 1j * starts[:, 1, 3]
        self.pose = Pose(math.array(place), math.array(np.angle(ahead)), math.array(starts[:, 2, 3]))
        self.told = self.pose  # what the arm says of itself: of the step before
        self._most = _columns(limits.linear_acceleration, limits.angular_acceleration, math)
        self._jerk = _columns(limits.linear_jerk, limits.angular_jerk, math)
        self._speed = math.array(np.zeros((4, len(arms))))  # ahead, left, down and turning
        self._growth = 0.0 * self._speed
        self.target = self._speed

    def advance(self, dt: float) -> None:
        """Go towards the target twists for `dt` seconds."""
        self.told, math = self.pose, self._math
        moved, self._speed, self._growth = profile(
            self._speed, self._growth, self.target, dt, self._most, self._jerk, math
        )
        old, turn = self.pose, moved[3]
        way = (moved[0] + 1j * moved[1]) * math.exp(0.5j * turn) * (1.0 - turn * turn / 24.0)
        at = old.at + way * math.exp(1j * old.turn)
        self.pose = Pose(at, old.turn + turn, old.height - moved[2])


def profile(
    v: Array, a: Array, target: Array, dt: float, most: Array, jerk: Array, math: ArrayMath
) -> tuple[Array, Array, Array]:
    """The fastest way of speeds v with accelerations a to targets, as Ruckig's: way, speed, acceleration."""
    side = math.where(target >= v + a * abs(a) / (2.0 * jerk), 1.0 + 0.0 * v, -1.0)
    a, rise = side * a, side * (target - v)
    peak = math.sqrt(math.clip(jerk * rise + 0.5 * a * a, 0.0, None))
    cut = math.minimum(peak, most)
    up, down = math.clip(cut - a, 0.0, None) / jerk, cut / jerk
    level = math.where(peak > most, (rise - (2.0 * cut * cut - a * a) / (2.0 * jerk)) / most, 0.0)
    first = math.clip(up, 0.0, dt)
    second = math.minimum(math.clip(dt - up, 0.0, None), level)
    third = math.minimum(math.clip(dt - up - level, 0.0, None), down)
    way, speed = 0.0 * v, side * v
    for time, change in ((first, jerk), (second, 0.0), (third, -jerk)):
        way = way + time * (speed + time * (0.5 * a + time * change / 6.0))
        speed, a = speed + time * (a + 0.5 * time * change), a + time * change
    there = dt >= up + level + down
    way = side * (way + (dt - first - second - third) * speed)
    return way, math.where(there, target, side * speed), math.where(there, 0.0, side * a)


def _columns(linear: float, angular: float, math: ArrayMath) -> Array:
    return math.array(np.array([[linear], [linear], [linear], [angular]]))


class PlaneSensor:
    """N ideal sensors of one arm on N objects: `IdealSensor` in arrays."""

    def __init__(
        self,
        models: Sequence[IdealSensorSettings],
        seeds: Sequence[int],
        bodies: PlaneBodies,
        math: ArrayMath,
    ) -> None:
        self._math, self._bodies = math, bodies
        model = models[0]
        self.radius = model.radius
        self._limits = np.array(model.shear_depths), np.array(model.shear_limits)
        self.sigma = np.array([_sigma(each) for each in models]).T  # (4, N): ahead, left, down, turning
        self._random = [np.random.default_rng(seed) for seed in seeds]
        self._noise = np.zeros((BLOCK, 4, len(models)))
        self._drawn = math.array(self._noise)
        self._number, self._began = 0, np.zeros(len(models), bool)
        skins = bodies.skins
        self._press, self._exponent, self._across, self._across_exponent, self._friction = (
            math.array(np.array([getattr(skin, name) for skin in skins]))
            for name in ("skin_force", "skin_exponent", "skin_shear", "skin_shear_exponent", "friction_tip")
        )
        nothing = 0.0 * bodies.at.real
        self._touched = nothing > 1.0
        self._anchor, self._anchor_up = 0.0 * bodies.at, nothing
        self._place, self._heading, self._up = 0.0 * bodies.at, nothing, nothing
        self._point, self._normal, self._depth = 0.0 * bodies.at, 0.0 * bodies.at + 1.0, nothing
        self.tips = self._tips(self._touched, self._place, nothing, nothing)

    def expose(self, pose: Pose) -> Seen:
        """Move on to where the sensors are now, and say what they see."""
        math, bodies = self._math, self._bodies
        place = math.exp(-1j * bodies.angle) * (pose.at - bodies.at)
        heading = pose.turn - bodies.angle
        distance, normal = bodies.outlines.nearest(place, math)
        point, depth = place - distance * normal, self.radius - distance
        touches = depth > 0.0
        slips, anchor, anchor_up = self._dragged(place, heading, pose.height, point, normal, depth)
        new = touches & ~self._touched
        self._anchor = math.where(new, point, anchor)
        self._anchor_up = math.where(new, pose.height, anchor_up)
        slips = slips & touches & self._touched
        self._touched, self._place, self._heading, self._up = touches, place, heading, pose.height
        self._point, self._normal, self._depth = point, normal, depth
        way = point - self._anchor  # the left of {f}, which looks along -normal, is -i normal
        left, down = dot(way, -1j * normal) * touches, (self._anchor_up - pose.height) * touches
        self.tips = self._tips(touches, place, left, down)
        return self._seen(pose, left, down, slips)

    def _dragged(
        self, place: Array, heading: Array, up: Array, point: Array, normal: Array, depth: Array
    ) -> tuple[Array, Array, Array]:
        """Which slip, and where the anchors are then: `point_contact_drag` in C."""
        math = self._math
        matter = self._point - (1.0 - PRESSED) * self._depth * self._normal
        turned = math.exp(1j * (heading - self._heading)) * (matter - self._place)
        offset = turned + place - matter + self._point - self._anchor
        offset = offset - dot(offset, normal) * normal
        offset_up = up - self._anchor_up
        length = math.sqrt(dot(offset, offset) + offset_up * offset_up)
        limit = table(depth, *self._limits, math)
        slips = length > limit
        kept = math.where(slips, limit / math.clip(length, TINY, None), 1.0)
        return slips, point - kept * offset, up - kept * offset_up

    def _tips(self, touches: Array, place: Array, left: Array, down: Array) -> Tips:
        """What the objects feel of it: `SkinForces`."""
        math, deep = self._math, self._math.clip(self._depth, TINY, None) / REFERENCE_DEPTH
        press = self._press * deep**self._exponent * touches
        across = self._across * deep**self._across_exponent * touches
        along = self._exponent * press / (deep * REFERENCE_DEPTH)
        size = across * math.sqrt(left * left + down * down)
        part = math.where(size > self._friction * press, self._friction * press / (size + TINY), 1.0)
        force = -press * self._normal - 1j * self._normal * part * across * left
        matter = math.exp(-1j * self._heading) * (self._point - place)
        up = -part * across * down
        return Tips(touches, self._point, self._normal, force, up, self._up, matter, along, across)

    def _seen(self, pose: Pose, left: Array, down: Array, slips: Array) -> Seen:
        math, normal = self._math, -self._math.exp(1j * self._bodies.angle) * self._normal
        tilt = self._heading - math.arctan2(-self._normal.imag, -self._normal.real)
        at = -(self._depth + 1j * left) * math.exp(-1j * tilt)
        ahead, beside, low, about = self._next_noise()
        turned = math.exp(-1j * about)
        return Seen(
            present=self._touched,
            at=turned * at + (ahead + 1j * beside) * math.exp(-0.5j * about),
            turn=wrapped(-tilt - about, math),
            down=low - down,
            normal=normal,
            depth=self._depth,
            shear=math.sqrt(left * left + down * down),
            slips=slips,
            pose=pose,
        )

    def _next_noise(self) -> Array:
        """Errors (4, N) of an exposure; each trial's begin with its contact, as the ideal sensor's do."""
        row = self._number % BLOCK
        begin = ~self._began & np.asarray(self._math.numpy(self._touched), bool)
        which = np.flatnonzero(self._began) if row == 0 else ()
        for rows, trials in ((0, which), (row, np.flatnonzero(begin))):
            for trial in trials:
                drawn = self._random[trial].standard_normal((BLOCK - rows, 6))[:, _IN_PLANE]
                self._noise[rows:, :, trial] = drawn * self.sigma[:, trial]
        if len(which) or begin.any():
            self._drawn = self._math.array(self._noise)
        self._began |= begin
        self._number += 1
        return self._drawn[row]


def _sigma(model: IdealSensorSettings) -> list[float]:
    x, y, z = model.sigma_position
    return [z, y, x, model.sigma_rotation[0]]


def table(x: Array, at: Any, values: Any, math: ArrayMath) -> Array:
    """`numpy.interp`."""
    found = 0.0 * x + values[0]
    for left, right, slope in zip(at[:-1], at[1:], np.diff(values) / np.diff(at), strict=True):
        found = found + slope * (math.clip(x, left, right) - left)
    return found


def wrapped(angle: Array, math: ArrayMath) -> Array:
    """In (-pi, pi]."""
    return math.arctan2(math.sin(angle), math.cos(angle))


class PlaneCell:
    """The simulated cells of N scenes that differ in numbers alone: the same arms and rates.

    Attributes
    ----------
    arms, sensors : of each arm of the scenes, in their order
    bodies : what is pushed
    """

    def __init__(self, scenes: Sequence[Scene], seeds: Sequence[int], math: ArrayMath) -> None:
        self._math, scene = math, scenes[0]
        self.dt = 1.0 / scene.simulation.rate
        pushed = [next(body for body in each.bodies.values() if body.motion == MOTION) for each in scenes]
        self.bodies = PlaneBodies(scenes, pushed, math)
        self.arms = [PlaneArm([each.arms[name] for each in scenes], math) for name in scene.arms]
        own = np.array([np.random.SeedSequence(seed).generate_state(len(self.arms)) for seed in seeds])
        self.sensors = [
            PlaneSensor([_model(each, name) for each in scenes], own[:, k].tolist(), self.bodies, math)
            for k, name in enumerate(scene.arms)
        ]
        apart = np.array([[_apart(each, name) for each in scenes] for name in scene.arms])
        self._apart = [
            (math.array(way), math.array(turn.real)) if way.any() or turn.any() else None
            for way, turn in np.moveaxis(apart, 2, 1)
        ]
        self.frame_ticks = [
            round(scene.simulation.rate / arm.sensor.settings.camera_rate)
            for arm in scene.arms.values()
            if arm.sensor is not None
        ]
        self.ticks = 0

    def step(self) -> None:
        """Move arms and objects on by a step of the simulation."""
        self.ticks += 1
        for arm in self.arms:
            arm.advance(self.dt)
        poses = [(pose.at, pose.turn, pose.height) for pose in map(self.sensor_pose, range(len(self.arms)))]
        self.bodies.step([sensor.tips for sensor in self.sensors], poses)

    def exposure_due(self, arm: int) -> bool:
        """Whether a camera exposes at the present step."""
        return self.ticks % self.frame_ticks[arm] == 0

    def expose(self, arm: int) -> Seen:
        """Expose the sensors of an arm."""
        return self.sensors[arm].expose(self.sensor_pose(arm))

    def sensor_pose(self, arm: int) -> Pose:
        """Where the sensors of an arm are in truth."""
        said, apart = self.arms[arm].pose, self._apart[arm]
        return said if apart is None else said.shifted(*apart, self._math)


def _model(scene: Scene, arm: str) -> IdealSensorSettings:
    """The ideal sensor of an arm; `SettingError` where it is another, or late."""
    sensor = scene.simulation.sensors.get(arm)
    if sensor is None or type(sensor.model) is not IdealSensorSettings or sensor.delay:
        raise SettingError(
            f"fidelity plane: arm '{arm}' has to have a sensor that is simulated, without delay"
        )
    return sensor.model


def _apart(scene: Scene, arm: str) -> tuple[complex, complex]:
    """Where an arm's sensor is in truth, in the one that the scene tells of: way and turn.

    Raises `SettingError` where the one is turned or moved out of the plane of the other.
    """
    T = scene.T_controlled_sensor(arm)
    if abs(T[0] - [1.0, 0.0, 0.0, 0.0]).max() > 1e-9:
        raise SettingError(f"fidelity plane: the sensor of arm '{arm}' is not level in truth")
    return complex(T[2, 3], T[1, 3]), complex(np.arctan2(T[1, 2], T[2, 2]))
