"""Pushed objects in the plane of the floor, many at once in arrays: `pushed` without what leaves the plane.

Places and directions (N,) are complex numbers, x + iy, so that a product with exp(i angle) turns them;
heights are apart. Outlines, feet, masses and frictions are those of the scenes, and so is the law of motion:
the same return to the limit surface as in `_csrc/pushed.c`, as a polynomial in the multiplier. No object
tilts here: `tilts` says which would.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tactile_base.array_math import ArrayMath
from tactile_base.settings import SettingError
from tactile_scene.scene import BodyScene, Scene
from tactile_scene.shapes.box import Box
from tactile_scene.shapes.cylinder import Cylinder
from tactile_scene.shapes.prism import Prism
from tactile_scene.shapes.surface import Surface
from tactile_sim.held import GRAVITY
from tactile_sim.motions import make_motion
from tactile_sim.pushed import Pushed

Array = Any  # of the library in use

LEAST_LOAD = 0.05  # as in _csrc/pushed.c
ROUNDS, STILL = 5, 1e-7  # of the return in a step while a tip slips; m of motion that ends them
NEWTON_STEPS = 12
TINY = 1e-12


def dot(a: Array, b: Array) -> Array:
    """Products of directions (N,)."""
    return a.real * b.real + a.imag * b.imag


def cross(a: Array, b: Array) -> Array:
    """How far b is to the left of a, (N,)."""
    return a.real * b.imag - a.imag * b.real


@dataclass(frozen=True)
class Outlines:
    """Objects from above: all within `rounding` of a core, whose sides (F, N) have outward normals.

    `inner` is a side's distance from the middle, `half` half its length, m. A round object has no core.
    """

    normals: Array
    inner: Array
    half: Array
    rounding: Array
    first: Array

    @classmethod
    def of(cls, surfaces: Sequence[Surface], math: ArrayMath) -> Outlines:
        """Those of boxes, prisms and upright cylinders; `SettingError` for another shape."""
        sides = [_sides(surface) for surface in surfaces]
        count = max(len(normals) for normals, *_ in sides)
        padded = [[np.resize(part, count) for part in parts] for *parts, _ in sides]
        normals, inner, half = (math.array(np.array(part).T) for part in zip(*padded, strict=True))
        rounding = math.array(np.array([rounding for *_, rounding in sides]))
        return cls(normals, inner, half, rounding, math.array(np.arange(len(sides))))

    def nearest(self, p: Array, math: ArrayMath) -> tuple[Array, Array]:
        """Distances (N,) of places outside the cores, in the objects' frames, and outward normals (N,)."""
        beyond = dot(self.normals, p) - self.inner
        side = math.argmax(beyond, axis=0) * len(p) + self.first
        normal, inner, half = (
            math.take(part.reshape(-1), side) for part in (self.normals, self.inner, self.half)
        )
        ahead, along = dot(normal, p) - inner, cross(normal, p)
        way = (ahead + 1j * (along - math.clip(along, -half, half))) * normal
        distance = math.maximum(abs(way), self.rounding * 0.0 + TINY)
        return distance - self.rounding, way / distance


def _sides(surface: Surface) -> tuple[Any, Any, Any, float]:
    s: Any = surface.settings
    if isinstance(surface, Cylinder) and s.axis == "z" and s.ends:
        return np.ones(1, complex), np.zeros(1), np.zeros(1), s.radius
    if isinstance(surface, Box):
        x, y = (0.5 * size - s.rounding for size in s.size[:2])
        return np.array([1.0, 1j, -1.0, -1j]), np.array([x, y, x, y]), np.array([y, x, y, x]), s.rounding
    if isinstance(surface, Prism):
        sector, inner = 2.0 * np.pi / s.sides, np.full(s.sides, 0.5 * s.width - s.rounding)
        normals = 1j * np.exp(1j * sector * np.arange(s.sides))
        return normals, inner, inner * np.tan(0.5 * sector), s.rounding
    raise SettingError(
        f"fidelity plane: it knows boxes, prisms and upright cylinders, not {type(surface).__name__.lower()}"
    )


@dataclass
class Tips:
    """Contacts of one arm as of the last exposure, from which forces are carried on; frames as in `pushed.h`.

    Attributes
    ----------
    touches : (N,) conditions
    point, normal, force : in the bodies; `up` is the vertical part of the force, `height` where it acts
    matter : the tip's, at the contact, in the sensors
    along, across : stiffness of the skin, N/m
    """

    touches: Array
    point: Array
    normal: Array
    force: Array
    up: Array
    height: Array
    matter: Array
    along: Array
    across: Array


@dataclass
class _Touch:
    force: Array
    up: Array
    point: Array
    height: Array
    normal: Array
    along: Array
    across: Array
    slips: Array


class PlaneBodies:
    """N objects on their floors.

    Attributes
    ----------
    at, angle : (N,) places of their origins, m, and turns, rad, in the world
    turn : (N,) since the start, rad
    tilts : (N,) conditions: it has begun to tilt, which is not modelled
    """

    def __init__(self, scenes: Sequence[Scene], bodies: Sequence[BodyScene], math: ArrayMath) -> None:
        self._math = math
        motions: list[Any] = [make_motion(s, body) for s, body in zip(scenes, bodies, strict=True)]
        if not all(isinstance(motion, Pushed) for motion in motions):
            raise SettingError("fidelity plane: the body has to have the motion 'pushed'")
        for s in (motion.settings for motion in motions):
            if s.model != "ellipsoid" or s.friction_field or s.friction_speed:
                raise SettingError(
                    "fidelity plane: knows only a floor of model 'ellipsoid' without friction_field and "
                    "friction_speed; choose --fidelity ideal"
                )

        def each(value: Callable[[Any], Any]) -> Array:
            return math.array(np.array([value(motion) for motion in motions]))

        self.skins = [motion.settings for motion in motions]
        self.outlines = Outlines.of([body.make() for body in bodies], math)
        starts = np.array([s.T_world_body(body.name) for s, body in zip(scenes, bodies, strict=True)])
        self.at = math.array(starts[:, 0, 3] + 1j * starts[:, 1, 3])
        self.angle = math.array(np.arctan2(starts[:, 1, 0], starts[:, 0, 0]))
        self.turn = 0.0 * self.angle
        self.tilts = self.turn > 1.0
        self._weight = each(lambda m: m.settings.mass * -GRAVITY[2])
        self._floor = self.friction = each(lambda m: m.settings.friction)
        self._off = each(lambda m: complex(*m.settings.center_of_friction))
        self._gravity = each(lambda m: complex(*m.settings.center_of_gravity[:2]))
        self._tip_friction = each(lambda m: m.settings.friction_tip)
        self._pressure = each(lambda m: complex(*m.pressure))
        self._load = 0.0 * self.turn + 1.0
        self._arm = each(lambda m: m.foot.arm)
        self._foot = _Feet([motion.foot for motion in motions], math)
        self._edge_friction = each(lambda m: m.settings.edge_friction)
        self._edge_way, self._slid = each(lambda m: m.settings.edge_way), 0.0 * self.turn
        self._catches = any(motion.settings.edge_friction > 0.0 for motion in motions)

    def step(self, tips: Sequence[Tips], sensors: Sequence[tuple[Array, Array, Array]]) -> None:
        """Move as tips push whose sensors are at these places, turns and heights now: see `pushed_step`."""
        moving, way = self.turn * 0.0 == 0.0, 0.0 * self.turn
        for _ in range(ROUNDS):
            touches = [self._push(*each) for each in zip(tips, sensors, strict=True)]
            moved = self._slide(touches, moving)
            way = way + moved
            slips = touches[0].slips
            for touch in touches[1:]:
                slips = slips | touch.slips
            moving = moving & slips & (moved >= STILL)
            if not bool(moving.any()):
                break
        self._settle([self._push(*each) for each in zip(tips, sensors, strict=True)])
        if self._catches:
            self._catch(way)

    def _push(self, tip: Tips, sensor: tuple[Array, Array, Array]) -> _Touch:
        """What a tip does to bodies that stay where they are: `push` in C."""
        math, e = self._math, self._math.exp(1j * self.angle)
        at, turn, height = sensor
        point, normal = self.at + e * tip.point, e * tip.normal
        way = at + math.exp(1j * turn) * tip.matter - point
        f = e * tip.force + tip.across * way + (tip.along - tip.across) * dot(way, normal) * normal
        up, press = tip.up + tip.across * (height - tip.height), -dot(f, normal)
        shear, press = f + press * normal, math.clip(press, 0.0, None)
        size = math.sqrt(dot(shear, shear) + up * up)
        limit = self._tip_friction * press
        slips = tip.touches & (size > limit)
        left = math.where(slips, limit / math.clip(size, TINY, None), 1.0) * tip.touches
        force = left * shear - tip.touches * press * normal
        return _Touch(force, left * up, point, tip.height, normal, tip.along, tip.across, slips)

    def _slide(self, touches: Sequence[_Touch], moving: Array) -> Array:
        """Move until friction carries these pushes; how far, m."""
        math, around = self._math, self._math.exp(1j * self.turn)
        center = self.at + around * (self._pressure + self._off)
        most = self.friction * self._load * self._weight
        scale = 1.0 / most, 1.0 / most, 1.0 / (most * self._arm)
        load = [0.0 * self.turn] * 3
        for touch in touches:
            arm = touch.point - center
            for k, part in enumerate((touch.force.real, touch.force.imag, cross(arm, touch.force))):
                load[k] = load[k] + scale[k] * part
        over = moving & (load[0] ** 2 + load[1] ** 2 + load[2] ** 2 > 1.0)
        motion, held = returned(load, _stiffness(touches, center, scale, False, math), math)
        if not bool((held | ~over).all()):  # tips that slip carry some along: those go until they stick
            stuck, _ = returned(load, _stiffness(touches, center, scale, True, math), math)
            motion = [math.where(held, one, other) for one, other in zip(motion, stuck, strict=True)]
        dx, dy, turn = (math.where(over, part * s, 0.0) for part, s in zip(motion, scale, strict=True))
        self.at = center + dx + 1j * dy + math.exp(1j * turn) * (self.at - center)
        self.angle, self.turn = self.angle + turn, self.turn + turn
        return math.sqrt(dx * dx + dy * dy) + abs(turn) * self._arm

    def _settle(self, touches: Sequence[_Touch]) -> None:
        """Where the floor presses, and how much: `settle` in C."""
        math = self._math
        moment = self._weight * (self.at + math.exp(1j * self.angle) * self._gravity)
        lifted = 0.0 * self.turn
        for touch in touches:
            moment = moment + touch.height * touch.force - touch.up * touch.point
            lifted = lifted + touch.up
        self._load = math.clip(1.0 - lifted / self._weight, LEAST_LOAD, None)
        self._pressure = math.exp(-1j * self.turn) * (moment / (self._load * self._weight) - self.at)

    def _catch(self, way: Array) -> None:
        """What leading edges carry that have slid under load: `pushed_tilt` in C, without the tilt."""
        math, (share, inside) = self._math, self._foot.edge_share(self._pressure, self._math)
        self._slid = math.where(share > 0.0, self._slid + way, 0.0)
        caught = math.where(self._slid > self._edge_way, share, 0.0) * (self._edge_friction > 0.0)
        self.friction = self._floor + caught * (self._edge_friction - self._floor)
        self.tilts = self.tilts | ((inside < 0.0) & (self._edge_friction > 0.0))


class _Feet:
    """What N objects stand on, padded to as many corners (E, N)."""

    def __init__(self, feet: Sequence[Any], math: ArrayMath) -> None:
        count = max(len(foot.corners) for foot in feet)
        edges = np.array([np.resize(foot.numbers[0], (count, 5)) for foot in feet]).transpose(2, 1, 0)
        self._corners = math.array(edges[0] + 1j * edges[1])
        self._inward, self._offset = math.array(edges[2] + 1j * edges[3]), math.array(edges[4])
        centers = np.array([foot.center for foot in feet]).T
        self._middle = math.array(centers[0] + 1j * centers[1])
        inverse = np.linalg.inv(np.array([foot.spread for foot in feet]))
        self._xx, self._xy, self._yy = (math.array(inverse[:, i, j]) for i, j in ((0, 0), (0, 1), (1, 1)))

    def edge_share(self, center: Array, math: ArrayMath) -> tuple[Array, Array]:
        """`Foot.edge_share` and `Foot.inside`, (N,) each."""
        ahead = center - self._middle
        slope = self._xx * ahead.real + self._xy * ahead.imag
        slope = slope + 1j * (self._xy * ahead.real + self._yy * ahead.imag)
        over = math.amax(-dot(self._corners - self._middle, slope), axis=0)
        inside = dot(self._inward, center) - self._offset
        there = math.amax(1.0 - inside / (dot(self._inward, self._middle) - self._offset), axis=0)
        share = math.where(there >= 1.0, 1.0, (over - 1.0) / (over / math.clip(there, TINY, None) - 1.0))
        return math.where(over <= 1.0, 0.0, share), -math.amax(-inside, axis=0)


def _stiffness(
    touches: Sequence[_Touch], center: Array, scale: Sequence[Array], sticks: bool, math: ArrayMath
) -> list[Array]:
    """xx, xy, yy, xt, yt and tt of how fast scaled loads fall: `planar_stiffness` in C."""
    found: list[Array] = [0.0 * scale[0]] * 6
    for touch in touches:
        across = touch.across if sticks else math.where(touch.slips, 0.0, touch.across)
        more, arm, n = touch.along - across, touch.point - center, touch.normal
        xx, xy, yy = across + more * n.real**2, more * n.real * n.imag, across + more * n.imag**2
        by_x, by_y = arm.real * xy - arm.imag * xx, arm.real * yy - arm.imag * xy
        parts = xx, xy, yy, by_x, by_y, arm.real * by_y - arm.imag * by_x
        found = [old + part for old, part in zip(found, parts, strict=True)]
    s, m = scale[0], scale[2]
    return [part * by for part, by in zip(found, (s * s, s * s, s * s, s * m, s * m, m * m), strict=True)]


def returned(load: Sequence[Array], stiffness: Sequence[Array], math: ArrayMath) -> tuple[list[Array], Array]:
    """Motions (3 of (N,), scaled) that leave loads of size 1, and where there are such: `return_to_surface`.

    With S the stiffness and u the load, what is left at the multiplier x is (1 + x S)^-1 u, that is n(x) over
    d(x): n = u + x (tr S - S) u + x^2 adj(S) u, and d the characteristic cubic.
    """
    xx, xy, yy, xt, yt, tt = stiffness
    u, v, w = load
    a = yy * tt - yt * yt, xt * yt - xy * tt, xy * yt - yy * xt  # rows of adj(S)
    b = xx * tt - xt * xt, xt * xy - xx * yt, xx * yy - xy * xy
    second = a[0] * u + a[1] * v + a[2] * w, a[1] * u + b[0] * v + b[1] * w, a[2] * u + b[1] * v + b[2] * w
    trace, minors, det = xx + yy + tt, a[0] + b[0] + b[2], xx * a[0] + xy * a[1] + xt * a[2]
    first = (
        trace * u - (xx * u + xy * v + xt * w),
        trace * v - (xy * u + yy * v + yt * w),
        trace * w - (xt * u + yt * v + tt * w),
    )
    # |n|^2 as a polynomial of the fourth degree in x
    zeroth = u * u + v * v + w * w
    c1 = 2.0 * (u * first[0] + v * first[1] + w * first[2])
    c2 = sum(p * p for p in first) + 2.0 * (u * second[0] + v * second[1] + w * second[2])
    c3 = 2.0 * sum(p * q for p, q in zip(first, second, strict=True))
    c4 = sum(q * q for q in second)
    x = 0.0 * u
    for _ in range(NEWTON_STEPS):
        d, d_slope = 1.0 + x * (trace + x * (minors + x * det)), trace + x * (2.0 * minors + 3.0 * x * det)
        n = zeroth + x * (c1 + x * (c2 + x * (c3 + x * c4)))
        n_slope = c1 + x * (2.0 * c2 + x * (3.0 * c3 + 4.0 * x * c4))
        total = n / (d * d)
        slope = (2.0 * n * d_slope / d - n_slope) / (d * d)  # how fast the total falls
        x = x + 2.0 * total * (math.sqrt(total) - 1.0) / math.clip(slope, 1e-30, None)
        x = math.clip(x, 0.0, 1e30)
    d = 1.0 + x * (trace + x * (minors + x * det))
    left = [(p + x * (q + x * r)) / d for p, q, r in zip(load, first, second, strict=True)]
    held = abs(sum(p * p for p in left) - 1.0) < 1e-6
    return [x * p for p in left], held
