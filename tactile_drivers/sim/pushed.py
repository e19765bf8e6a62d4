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
from tactile_drivers.sim.toppling import Tipping, Touch
from tactile_filter import se3

if TYPE_CHECKING:
    from tactile_drivers.scene import BodyScene, Scene
    from tactile_drivers.sim.motions import BodyContact

Array = NDArray[np.float64]

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
        self._settings = settings
        self._point = contact.point
        self._in_sensor = contact.T_body_sensor[:3, :3].T @ (contact.point - contact.T_body_sensor[:3, 3])
        self._force, self._normal = settings.force_on_body(contact), contact.normal
        depth = contact.truth.depth
        self._along = settings.normal_stiffness(depth, -float(self._force @ self._normal))
        self._across = settings.shear_stiffness(depth)

    def push(self, T_world_body: Array, T_world_sensor: Array) -> Touch:
        """Its force with body and sensor where they are now.

        What stretches the skin is the way of the tip's matter at the contact over that of the body: a tip
        that rolls stretches nothing.
        """
        R = T_world_body[:3, :3]
        normal, point = R @ self._normal, R @ self._point + T_world_body[:3, 3]
        way = T_world_sensor[:3, :3] @ self._in_sensor + T_world_sensor[:3, 3] - point
        into = float(way @ normal)
        force = R @ self._force + self._across * way + (self._along - self._across) * into * normal
        press = max(0.0, -float(force @ normal))
        shear = force - float(force @ normal) * normal
        limit, size = self._settings.friction_tip * press, se3.norm(shear)
        slips = size > limit
        if slips:
            shear = shear * (limit / size)
        return Touch(shear - press * normal, point, normal, self._along, self._across, slips)


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
        self.pressure = center[:2]  # its centre, from the body's origin, along the world's axes at the start
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
        sensors = {arm: tools[arm] @ self._T_tool_sensor[arm] for arm in self._tips}
        moved = self._slide_on(sensors)
        self.state = PushedState.SLIDING if moved > 0.0 else PushedState.RESTING
        self._settle([tip.push(self._T, sensors[arm]) for arm, tip in self._tips.items()], moved)
        return self._T

    def _tip(self, contact: BodyContact) -> _Tip:
        known = self._tips.get(contact.arm)
        return known if known and known.stamp_ns == contact.stamp_ns else _Tip(contact, self.settings)

    def _slide_on(self, sensors: Mapping[str, Array]) -> float:
        """Move until friction carries the pushes; how far (m). More than once only while a tip slips."""
        way = 0.0
        for _ in range(_ROUNDS):
            pushes = [tip.push(self._T, sensors[arm]) for arm, tip in self._tips.items()]
            moved = self._slide(pushes)
            way += moved
            if moved < _STILL or not any(push.slips for push in pushes):
                break
        return way

    def _slide(self, pushes: Sequence[Touch]) -> float:
        center = self._upright[:2, 3] + _turned(
            self._turn, self.pressure + np.array(self.settings.center_of_friction)
        )
        load, stiffness = np.zeros(3), np.zeros((3, 3))
        for push in pushes:
            x, y = push.point[:2] - center
            G = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])  # how the point moves
            load += G.T @ push.force[:2]
            stiffness += G.T @ push.stiffness[:2, :2] @ G
        force = self.friction * self.load * self._weight
        arm = self._tipping.arm if self.tilt else self.foot.arm
        (dx, dy, turn), _ = return_to_surface(load.tolist(), stiffness, force, force * arm)
        if dx == dy == turn == 0.0:
            return 0.0
        self._turn += turn
        T = np.eye(4)
        T[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
        T[:2, 3] = center + np.array([dx, dy]) - T[:2, :2] @ center
        self._upright, self._T = T @ self._upright, T @ self._T
        return math.hypot(dx, dy) + abs(turn) * self.foot.arm

    def _settle(self, pushes: Sequence[Touch], moved: float) -> None:
        """Where the floor presses, and how much, from moments about the floor and vertical forces."""
        s, weight = self.settings, self._weight
        middle = self._T[:3, :3] @ np.array(s.center_of_gravity) + self._T[:3, 3]
        moment, lifted = weight * middle[:2], 0.0
        for push in pushes:
            moment = moment + push.point[2] * push.force[:2] - push.force[2] * push.point[:2]
            lifted += float(push.force[2])
        self.load = max(1.0 - lifted / weight, _LIFTED)
        pressure = _turned(-self._turn, moment / (self.load * weight) - self._upright[:2, 3])
        inside, edge = self.foot.inside(pressure), self.foot.edge_before(pressure)
        if s.edge_friction > 0:
            self._tip_over(pushes, edge, middle, inside < 0)
            share = self._caught(1.0 if self.tilt else self.foot.edge_share(pressure), moved)
            self.friction = s.friction + share * (s.edge_friction - s.friction)
            edge = self._tipping.edge or edge
        self.pressure = _onto(pressure, *edge) if inside < 0 or self.tilt else pressure

    def _caught(self, share: float, moved: float) -> float:
        """The part of the load on the leading edge, once that has caught."""
        self._edge_way = self._edge_way + moved if share > 0.0 else 0.0
        return share if self._edge_way > self.settings.edge_way else 0.0

    def _tip_over(
        self, pushes: Sequence[Touch], edge: tuple[Array, Array], middle: Array, beyond: bool
    ) -> None:
        """Tilt about an edge of the foot, back again, or over."""
        if not (beyond or self.tilt):
            return
        origin = self._upright[:2, 3]
        T = self._tipping.step(edge, lambda p: origin + _turned(self._turn, p), pushes, middle, self._weight)
        self._T = T @ self._upright
        if self.tilt:
            self.state = PushedState.TILTED
        if self._tipping.over:
            self.state = PushedState.TOPPLED
            self._T[2, 3] -= _BELOW


def _turned(angle: float, point: Array) -> Array:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]])


def _onto(point: Array, a: Array, b: Array) -> Array:
    """The nearest point (2,) of a segment."""
    share = float(np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0))
    return np.asarray(a + share * (b - a))


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
