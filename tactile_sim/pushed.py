"""An object that stands on the floor z = 0 and is pushed over it by the tips of one or more arms.

Quasi-static and planar: the friction of the floor carries the forces of the tips up to its limit surface, an
ellipsoid (`limit_surface`) or what `floor_models` has in its place; beyond it the object moves along the
surface's normal until the skins of the tips, which the motion relaxes, press no more than that. A tip's force
is what its sensor measured at the last exposure (or the skin's curves say), carried on by the skin's
stiffness as tip and object have moved since, at most to the friction of the skin. All of a step is solved at
once, by Newton's method with the tangent of tips that slip; one in which no motion balances is an error
(`ValueError`).

The floor presses with the weight less what the tips lift, centred where the moments of weight and tips
balance: pushed at a height h the pressure runs ahead of the centre of gravity by mu h. Its centre is that of
friction, plus `center_of_friction` for a floor or foot that is not even.

Where a scene says so (`edge_friction`), the leading edge catches and the object can topple: `toppling`. All
else of a step is in C (`_csrc/pushed.c`).

Assumed: no inertia; one friction for sticking and sliding; an ellipsoid's or polynomial's shape is that of an
even pressure, whose centre alone moves (docs/simulator.md says what this is off by); the skin's torsion
presses nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import LARGEST_SEED, SettingError, Settings, setting
from tactile_geometry import se3
from tactile_scene.shapes.surface import Surface
from tactile_sim._contact import PushedBody
from tactile_sim.floor_field import FloorField, speed_factor
from tactile_sim.floor_models import MODELS, even_points, floor_model
from tactile_sim.held import GRAVITY
from tactile_sim.limit_surface import Foot
from tactile_sim.skin_force import SkinForces
from tactile_sim.toppling import Tipping, Touch

if TYPE_CHECKING:
    from tactile_scene.scene import BodyScene, Scene
    from tactile_sim.motions import BodyContact

Array = NDArray[np.float64]

_FLAT = 1e-6  # m: points this near to the lowest carry the body
_NEAR = 5e-4  # m: off the floor, or into another body, that is taken for rounding
_SPEED_TIME = 0.1  # s, over which friction takes note of speed: at once, it would swing with the skin
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
    friction_field: float = setting(
        0.0, lower=0.0, upper=1.0,
        doc="standard deviation of friction over the floor, a smooth random field, as a part of it",
    )  # fmt: skip
    friction_field_length: float = setting(
        0.05, unit="m", lower=1e-3, upper=10.0, doc="over which that field changes"
    )
    friction_field_seed: int = setting(0, lower=0, upper=LARGEST_SEED, doc="which of such floors it is")
    friction_speed: float = setting(
        0.0, lower=-0.5, upper=1.0, doc="part by which friction grows with each tenfold of a speed of 10 mm/s"
    )
    model: str = setting(
        "ellipsoid", choices=MODELS,
        doc="of the floor's friction: an ellipsoid, Coulomb's law at points, or a convex polynomial",
    )  # fmt: skip
    points: tuple[float, ...] = setting(
        (), unit="m", lower=-1.0, upper=1.0,
        doc="x, y of each point that it stands on, in the body, one by one; empty: all over the foot",
    )  # fmt: skip
    polynomial: tuple[float, ...] = setting(
        (), lower=-1e6, upper=1e6,
        doc="xx, xy, xm, yy, ym, mm of each A in sum of (load' A load)^2 = 1, one after the other; load is "
        "(f_x, f_y, m / radius of gyration) over the friction, in the body",
    )  # fmt: skip
    edge_friction: float = setting(
        0.0, lower=0.0, upper=5.0,
        doc="of the leading edge where it catches on the floor, so that the object can topple; 0: never",
    )  # fmt: skip
    edge_way: float = setting(
        0.03, unit="m", lower=0.0, upper=10.0,
        doc="how far an edge slides under load until it meets something to catch on",
    )  # fmt: skip


class Pushed:
    """The motion `pushed` of a body."""

    settings_class: ClassVar[type[Settings]] = PushedSettings
    carriers: tuple[str, ...] = ()

    def __init__(self, scene: Scene, body: BodyScene, settings: PushedSettings) -> None:
        if body.carried_by:
            raise SettingError(f"body '{body.name}': motion 'pushed' cannot have carried_by")
        self.settings = s = settings
        self.foot = _foot(scene, body)
        turn = scene.T_world_body(body.name)[:2, :2]
        try:
            model = floor_model(s.model, self.foot, s.points, s.polynomial, turn)
            if s.model == "points" and s.points:
                self.foot = Foot.around(model[1])
        except SettingError as error:
            raise SettingError(f"body '{body.name}': {error}") from None
        self._speed = 0.0  # m/s
        self._field: FloorField | None = None
        if s.friction_field > 0.0:
            self._field = FloorField(s.friction_field, s.friction_field_length, s.friction_field_seed)
            self._under = model[1] if s.model == "points" else even_points(self.foot)
        self._T_tool_sensor = {
            name: arm.T_tool_controlled @ scene.T_controlled_sensor(name) for name, arm in scene.arms.items()
        }
        self._T = scene.T_world_body(body.name).copy()
        self._weight = s.mass * -GRAVITY[2]
        self._tips: dict[str, tuple[int, bytes]] = {}  # by arm, stamp of the exposure and what C keeps of it
        self._body = PushedBody(
            self.foot.numbers, self.foot.arm, self._T, s.center_of_gravity, self._weight, s.friction,
            s.center_of_friction, s.edge_friction, s.edge_way, s.friction_tip, model,
        )  # fmt: skip
        if self.foot.inside(self.pressure) <= 0:
            raise SettingError(
                f"body '{body.name}': center_of_gravity is {-1e3 * self.foot.inside(self.pressure):.1f} mm "
                "outside what the body stands on, so that it would fall over: move it inside"
            )
        self.state = PushedState.RESTING
        self._tipping = Tipping()
        _check_clear(scene, body)

    @property
    def tilt(self) -> float:
        """How far (rad) it is tilted about an edge of its foot."""
        return self._tipping.angle

    @property
    def pressure(self) -> tuple[float, float]:
        """Centre of the floor's pressure, m, from the body's origin along the world's axes at the start."""
        return self._body.pressure

    @property
    def load(self) -> float:
        """On the floor, over the weight."""
        return self._body.load

    @property
    def friction(self) -> float:
        """Over all of the foot."""
        return self._body.friction

    def step(self, dt: float, tools: Mapping[str, Array], contacts: Sequence[BodyContact]) -> Array:
        """T_world_body (4, 4), where the floor carries what the tips press."""
        if self.state is PushedState.TOPPLED:
            return self._T
        self._tips = {contact.arm: self._tip(contact) for contact in contacts}
        if not self._tips and not self.tilt:
            self.state = PushedState.RESTING
            return self._T
        if self._field or self.settings.friction_speed:
            self._floor_below(dt)
        pushes = [part for arm, (_, tip) in self._tips.items() for part in (tools[arm], tip)]
        touches = self._body.step(*pushes)
        self.state = PushedState.SLIDING if self._body.moved > 0.0 else PushedState.RESTING
        if touches is not None:
            self._lean([Touch(*touch) for touch in touches])
        elif self._body.moved > 0.0:
            self._T = self._body.T_world_body
        return self._T

    def _floor_below(self, dt: float) -> None:
        """Friction of the floor where the object is, at the speed that it had of late."""
        s, body = self.settings, self._body
        friction, center = s.friction, np.array(s.center_of_friction)
        if self._field:
            R_turn = se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, body.turn])[:2, :2]
            factor, off = self._field.under(body.T_world_upright[:2, 3] + self._under @ R_turn.T)
            friction, center = friction * factor, center + R_turn.T @ off
        if s.friction_speed:
            self._speed += min(dt / _SPEED_TIME, 1.0) * (body.moved / dt - self._speed)
            friction *= speed_factor(self._speed, s.friction_speed)
        body.set_floor(friction, center)

    def _tip(self, contact: BodyContact) -> tuple[int, bytes]:
        known = self._tips.get(contact.arm)
        if known and known[0] == contact.stamp_ns:
            return known
        s, normal, depth = self.settings, contact.normal, contact.truth.depth
        force = s.force_on_body(contact)
        along, across = s.normal_stiffness(depth, -float(force.dot(normal))), s.shear_stiffness(depth)
        T_tool_sensor = self._T_tool_sensor[contact.arm]
        return contact.stamp_ns, self._body.tip(
            T_tool_sensor, contact.T_body_sensor, contact.point, normal, force, along, across
        )

    def _lean(self, touches: Sequence[Touch]) -> None:
        """Tilt about an edge of the foot, back again, or over."""
        body = self._body
        T_upright, R_turn = body.T_world_upright, se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, body.turn])[:2, :2]
        middle = (body.T_world_body @ [*self.settings.center_of_gravity, 1.0])[:3]
        edge = self.foot.edge_before(self.pressure)
        T = self._tipping.step(edge, lambda p: T_upright[:2, 3] + R_turn @ p, touches, middle, self._weight)
        self._T = T @ T_upright
        if self.tilt:
            self.state = PushedState.TILTED
        body.lean(self._T, self._tipping.arm, np.stack(self._tipping.edge or edge))
        if self._tipping.over:
            self.state = PushedState.TOPPLED
            self._T[2, 3] -= _BELOW


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
