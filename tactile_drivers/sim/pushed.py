"""An object that stands on the floor z = 0 and is pushed over it by the tips of one or more arms.

Quasi-static and planar: the friction of the floor carries the forces of the tips up to an ellipsoidal limit
surface (`limit_surface`); beyond it the object moves along the surface's normal until the skins of the tips,
which the motion relaxes, press no more than that. A tip's force is what its sensor measured at the last
exposure (or the skin's curves say), carried on by the skin's stiffness as tip and object have moved since,
at most to the friction of the skin.

The floor presses with the weight less what the tips lift, centred where the moments of weight and tips
balance: pushed at a height h the pressure runs ahead of the centre of gravity by mu h. Its centre is that of
friction, plus `center_of_friction` for a floor or foot that is not even.

Where a scene says so (`edge_friction`), the leading edge catches and the object can topple: `toppling`.

Assumed: no inertia; one friction for sticking and sliding; the shape of the limit surface that of an even
pressure, whose centre alone moves (bench/pushed_objects.py says what this is off by); the skin's torsion
presses nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings, setting
from tactile_drivers.shapes.surface import Surface
from tactile_drivers.sim.held import GRAVITY
from tactile_drivers.sim.limit_surface import Foot, return_to_surface
from tactile_drivers.sim.skin_force import SkinForces
from tactile_drivers.sim.toppling import Tipping, Touch, planar_stiffness
from tactile_filter import se3

if TYPE_CHECKING:
    from tactile_drivers.scene import BodyScene, Scene
    from tactile_drivers.sim.motions import BodyContact

Array = NDArray[np.float64]
Rows = list[list[float]]  # of a pose (4, 4): a step works on few numbers, where arrays take most of the time

_FLAT = 1e-6  # m: points this near to the lowest carry the body
_NEAR = 5e-4  # m: off the floor, or into another body, that is taken for rounding
_LIFTED = 0.05  # least part of the weight on the floor: below, it would be carried, which is not modelled
_ROUNDS = 5  # of return mapping in a step, while a tip slips
_STILL = 1e-7  # m: motion that ends them
# A toppled object lies out of the tips' reach at once: the quasi-static skin could not push it aside.
_BELOW = 0.5  # m


class PushedState(Enum):
    """What a pushed object does."""

    RESTING = "resting"
    SLIDING = "sliding"
    TILTED = "tilted"
    TOPPLED = "toppled"


@dataclass(frozen=True)
class PushedSettings(SkinForces):
    """A pushed object; the default is the paper's large blue square on MDF."""

    mass: float = setting(0.479, unit="kg", lower=1e-3, upper=10.0, doc="of the object")
    center_of_gravity: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), unit="m", lower=-1.0, upper=1.0, length=3, doc="in the body's frame"
    )
    friction: float = setting(0.3, lower=1e-3, upper=5.0, doc="between object and floor")
    center_of_friction: tuple[float, ...] = setting(
        (0.0, 0.0), unit="m", lower=-0.1, upper=0.1, length=2,
        doc="of floor and foot, off the centre of pressure, along the world's x and y at the start",
    )  # fmt: skip
    edge_friction: float = setting(
        0.0, lower=0.0, upper=5.0,
        doc="of the leading edge where it catches on the floor, so that the object can topple; 0: never",
    )  # fmt: skip
    edge_way: float = setting(
        0.02, unit="m", lower=0.0, upper=10.0,
        doc="how far an edge slides under load until it meets something to catch on",
    )  # fmt: skip


class _Tip:
    """One sensor's contact as of its last exposure, from which its force is carried on."""

    def __init__(self, contact: BodyContact, settings: PushedSettings) -> None:
        self.stamp_ns = contact.stamp_ns
        force, normal, depth = settings.force_on_body(contact), contact.normal, contact.truth.depth
        T = contact.T_body_sensor
        self._in_body = [*np.stack([contact.point, normal, force]).tolist()]
        self._in_sensor = (T[:3, :3].T @ (contact.point - T[:3, 3])).tolist()
        self._along = settings.normal_stiffness(depth, -float(force @ normal))
        self._across = settings.shear_stiffness(depth)
        self._friction = settings.friction_tip

    def push(self, T_world_body: Rows, T_world_sensor: Rows) -> Touch:
        """Its force with body and sensor where they are now.

        What stretches the skin is the way of the tip's matter at the contact over that of the body: a tip
        that rolls stretches nothing.
        """
        point, normal, force = self._in_body
        p = _moved(T_world_body, point, 1.0)
        n, f = _moved(T_world_body, normal), _moved(T_world_body, force)
        way = [m - q for m, q in zip(_moved(T_world_sensor, self._in_sensor, 1.0), p, strict=True)]
        more = (self._along - self._across) * (way[0] * n[0] + way[1] * n[1] + way[2] * n[2])
        f = [a + self._across * w + more * b for a, w, b in zip(f, way, n, strict=True)]
        press = -(f[0] * n[0] + f[1] * n[1] + f[2] * n[2])
        shear = [a + press * b for a, b in zip(f, n, strict=True)]
        press = max(0.0, press)
        limit = self._friction * press
        size = math.sqrt(shear[0] * shear[0] + shear[1] * shear[1] + shear[2] * shear[2])
        left = limit / size if size > limit else 1.0
        f = [left * a - press * b for a, b in zip(shear, n, strict=True)]
        return Touch(f, p, n, self._along, self._across, size > limit)


class Pushed:
    """The motion `pushed` of a body."""

    settings_class: ClassVar[type[Settings]] = PushedSettings
    carriers: tuple[str, ...] = ()

    def __init__(self, scene: Scene, body: BodyScene, settings: PushedSettings) -> None:
        if body.carried_by:
            raise SettingError(f"body '{body.name}': motion 'pushed' cannot have carried_by")
        self.settings = settings
        self.foot = _foot(scene, body)
        self._T_tool_sensor = {name: arm.T_tool_controlled for name, arm in scene.arms.items()}
        self._T = self._upright = scene.T_world_body(body.name).copy()
        self._turn, self._weight = 0.0, settings.mass * -GRAVITY[2]
        self._tips: dict[str, _Tip] = {}
        center = self._T[:3, :3] @ np.array(settings.center_of_gravity)
        if self.foot.inside(center[:2]) <= 0:
            raise SettingError(
                f"body '{body.name}': center_of_gravity is {-1e3 * self.foot.inside(center[:2]):.1f} mm "
                "outside what the body stands on, so that it would fall over: move it inside"
            )
        self.state = PushedState.RESTING
        # its centre, m, from the body's origin, along the world's axes at the start
        self.pressure = float(center[0]), float(center[1])
        self.load = 1.0  # on the floor, over the weight
        self.friction = settings.friction  # over all of the foot
        self._tipping = Tipping()
        self._edge_way = 0.0  # m, that the edge has slid under load
        _check_clear(scene, body)

    @property
    def tilt(self) -> float:
        """How far (rad) it is tilted about an edge of its foot."""
        return self._tipping.angle

    def step(self, dt: float, tools: Mapping[str, Array], contacts: Sequence[BodyContact]) -> Array:
        """T_world_body (4, 4), where the floor carries what the tips press."""
        if self.state is PushedState.TOPPLED:
            return self._T
        self._tips = {contact.arm: self._tip(contact) for contact in contacts}
        if not self._tips and not self.tilt:
            self.state = PushedState.RESTING
            return self._T
        sensors = [(tools[arm] @ self._T_tool_sensor[arm]).tolist() for arm in self._tips]
        moved = self._slide_on(sensors)
        self.state = PushedState.SLIDING if moved > 0.0 else PushedState.RESTING
        self._settle(self._pushes(sensors), moved)
        return self._T

    def _tip(self, contact: BodyContact) -> _Tip:
        known = self._tips.get(contact.arm)
        return known if known and known.stamp_ns == contact.stamp_ns else _Tip(contact, self.settings)

    def _pushes(self, sensors: Sequence[Rows]) -> list[Touch]:
        T: Rows = self._T.tolist()
        return [tip.push(T, sensor) for tip, sensor in zip(self._tips.values(), sensors, strict=True)]

    def _slide_on(self, sensors: Sequence[Rows]) -> float:
        """Move until friction carries the pushes; how far (m). More than once only while a tip slips."""
        way = 0.0
        for _ in range(_ROUNDS):
            pushes = self._pushes(sensors)
            moved = self._slide(pushes)
            way += moved
            if moved < _STILL or not any(push.slips for push in pushes):
                break
        return way

    def _slide(self, pushes: Sequence[Touch]) -> float:
        x, y = _turned(self._turn, *self.pressure)
        off_x, off_y = _turned(self._turn, *self.settings.center_of_friction)
        center = float(self._upright[0, 3]) + x + off_x, float(self._upright[1, 3]) + y + off_y
        load = [0.0, 0.0, 0.0]
        for push in pushes:
            fx, fy, _ = push.force
            load[0] += fx
            load[1] += fy
            load[2] += (push.point[0] - center[0]) * fy - (push.point[1] - center[1]) * fx
        force = self.friction * self.load * self._weight
        torque = force * (self._tipping.arm if self.tilt else self.foot.arm)
        if math.hypot(load[0] / force, load[1] / force, load[2] / torque) <= 1.0:
            return 0.0
        try:
            motion, _ = return_to_surface(load, planar_stiffness(pushes, center), force, torque)
        except ValueError:  # where tips that slip carry it along, it goes until they stick
            motion, _ = return_to_surface(load, planar_stiffness(pushes, center, True), force, torque)
        dx, dy, turn = motion.tolist()
        return self._go(dx, dy, turn, center)

    def _go(self, dx: float, dy: float, turn: float, center: tuple[float, float]) -> float:
        self._turn += turn
        x, y = _turned(turn, *center)
        cos, sin = math.cos(turn), math.sin(turn)
        T = np.array([[cos, -sin, 0.0, center[0] + dx - x], [sin, cos, 0.0, center[1] + dy - y],
                      [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])  # fmt: skip
        same = self._T is self._upright
        self._upright = T @ self._upright
        self._T = self._upright if same else T @ self._T
        return math.hypot(dx, dy) + abs(turn) * self.foot.arm

    def _settle(self, pushes: Sequence[Touch], moved: float) -> None:
        """Where the floor presses, and how much, from moments about the floor and vertical forces."""
        s, weight = self.settings, self._weight
        middle = _moved(self._T.tolist(), s.center_of_gravity, 1.0)
        x, y, lifted = weight * middle[0], weight * middle[1], 0.0
        for push in pushes:
            (fx, fy, fz), (px, py, pz) = push.force, push.point
            x, y, lifted = x + pz * fx - fz * px, y + pz * fy - fz * py, lifted + fz
        self.load = max(1.0 - lifted / weight, _LIFTED)
        floor = self.load * weight
        pressure = _turned(
            -self._turn, x / floor - float(self._upright[0, 3]), y / floor - float(self._upright[1, 3])
        )
        inside, edge = self.foot.inside(pressure), None
        if s.edge_friction > 0:
            if inside < 0 or self.tilt:
                self._tip_over(pushes, self.foot.edge_before(pressure), np.array(middle))
            share = self._caught(1.0 if self.tilt else self.foot.edge_share(pressure), moved)
            self.friction = s.friction + share * (s.edge_friction - s.friction)
            edge = self._tipping.edge
        if inside < 0 or self.tilt:
            pressure = _onto(np.array(pressure), *(edge or self.foot.edge_before(pressure)))
        self.pressure = pressure

    def _caught(self, share: float, moved: float) -> float:
        """The part of the load on the leading edge, once that has caught."""
        self._edge_way = self._edge_way + moved if share > 0.0 else 0.0
        return share if self._edge_way > self.settings.edge_way else 0.0

    def _tip_over(self, pushes: Sequence[Touch], edge: tuple[Array, Array], middle: Array) -> None:
        """Tilt about an edge of the foot, back again, or over."""
        origin = self._upright[:2, 3]
        T = self._tipping.step(
            edge, lambda p: origin + np.array(_turned(self._turn, *p)), pushes, middle, self._weight
        )
        self._T = T @ self._upright
        if self.tilt:
            self.state = PushedState.TILTED
        if self._tipping.over:
            self.state = PushedState.TOPPLED
            self._T[2, 3] -= _BELOW


def _moved(T: Rows, v: Sequence[float], one: float = 0.0) -> list[float]:
    """A point (one = 1) or direction (0) of three numbers in the frame that T leads to."""
    x, y, z = v
    return [row[0] * x + row[1] * y + row[2] * z + row[3] * one for row in T[:3]]


def _turned(angle: float, x: float, y: float) -> tuple[float, float]:
    cos, sin = math.cos(angle), math.sin(angle)
    return cos * x - sin * y, sin * x + cos * y


def _onto(point: Array, a: Array, b: Array) -> tuple[float, float]:
    """The nearest point (2,) of a segment."""
    share = float(np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0))
    x, y = (a + share * (b - a)).tolist()
    return x, y


def _foot(scene: Scene, body: BodyScene) -> Foot:
    """What the body stands on, from its origin along the world's axes at the start."""
    T = scene.T_world_body(body.name)
    points = body.make().grid().reshape(-1, 3) @ T[:3, :3].T
    lowest = float(points[:, 2].min())
    if abs(lowest + T[2, 3]) > _NEAR:
        raise SettingError(
            f"body '{body.name}': its lowest point is at z = {lowest + T[2, 3]:.4f} m, must stand on the "
            f"floor z = 0: set its position's z to {-lowest:.4f}"
        )
    try:
        return Foot.around(points[points[:, 2] < lowest + _FLAT, :2])
    except SettingError as error:
        raise SettingError(
            f"body '{body.name}': it stands on no area ({error}); give it a flat base"
        ) from None


def _check_clear(scene: Scene, body: BodyScene) -> None:
    """Refuse a body that overlaps a sensor or another body at the start."""
    surface, T = body.make(), scene.T_world_body(body.name)
    for name, arm in scene.arms.items():
        if arm.sensor is None:
            continue
        center = (se3.inverse(T) @ arm.T_world_start)[:3, 3]
        depth = arm.sensor.settings.tip_radius - float(surface.distance(center[None])[0])
        if depth > 0:
            raise SettingError(
                f"body '{body.name}' overlaps the tip of arm '{name}' by {1e3 * depth:.1f} mm at the start: "
                f"move the body or the arm's start apart by that much"
            )
    for name, other in scene.bodies.items():
        if name == body.name:
            continue
        there = (other.make(), scene.T_world_body(name))
        depth = max(_depth((surface, T), there), _depth(there, (surface, T)))
        if depth > _NEAR:
            raise SettingError(
                f"body '{body.name}' overlaps body '{name}' by {1e3 * depth:.1f} mm at the start: "
                "move one of them"
            )


def _depth(one: tuple[Surface, Array], other: tuple[Surface, Array]) -> float:
    """How deep (m) the surface or the middle of one body is in the other; each with its pose (4, 4)."""
    (surface, T), (around, T_other) = one, other
    points = np.concatenate([surface.grid().reshape(-1, 3), np.zeros((1, 3))])
    T_there = se3.inverse(T_other) @ T
    return -float(around.distance(points @ T_there[:3, :3].T + T_there[:3, 3]).min())
