"""An object that one arm's plate carries because another arm's tip presses it against the plate.

Quasi-static. The plate's frame has its origin in the middle of the plate and z out of it, towards the tip.
The forces on the object are its weight W, the tip's force F, and the plate's P = -(W + F). Three conditions
keep the object where it is; what of each is used up is 1 at its limit::

    pressed    P_z > 0                                      else it comes off the plate
    slip       |(P_xy, M / r)| / (mu P_z)                   friction and torsion: an ellipsoidal limit surface
    tilt       center of pressure within the foot           else it rocks on the foot's edge

Where `slip` is above 1 the object moves over the plate, along the normal of the limit surface: until the
shear of the tip's skin carries what the plate does not, or, once the tip slips as well, as a mass that the
rest of the load accelerates. Where `tilt` is above 1 it turns about the edge until the skin holds it up.
Off the plate, or tilted too far, it has fallen, for good. Under the tip's force it yields like a spring in
series with the skin.

Assumed: no inertia but that of a free slide (docs/simulator.md compares it with the weight), no
torsion from the tip, and a hand that holds the object until `hand_time` after the first touch.
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
from tactile_geometry import se3
from tactile_sim.skin_force import SkinForces

if TYPE_CHECKING:
    from tactile_scene.scene import BodyScene, Scene
    from tactile_sim.motions import BodyContact

Array = NDArray[np.float64]

GRAVITY = (0.0, 0.0, -9.81)  # m/s^2, in the world
_STEEPEST_DEG = 85.0  # of the friction cone and the rim together
_TIP_SLIPS = 0.95  # of the tip's friction: from here on its force grows no more
_TOPPLED = math.radians(15.0)  # tilt that nothing comes back from
# A fallen object is out of the tip's reach at once, along the plate's normal: the quasi-static skin could not
# push it aside while it falls past. After some exposures it lies on the floor.
_ASIDE, _ASIDE_FOR = 0.1, 0.5  # m, s
_FLOOR = 1.0  # m below


class HeldState(Enum):
    """What a held object does."""

    BY_HAND = "held by hand"
    STICKING = "sticking"
    SLIPPING = "slipping"
    ROCKING = "rocking"
    FALLEN = "fallen"


@dataclass(frozen=True)
class HeldSettings(SkinForces):
    """A held object; the default is a Rubik's cube on foam pads.

    Mass and size of the cube are those of the YCB object set. Stiffness (four foam pads, 20 x 20 x 5 mm, of
    50 kPa) and frictions are assumed.
    """

    mass: float = setting(0.094, unit="kg", lower=1e-3, upper=10.0, doc="of the object")
    standoff: float = setting(
        0.0285, unit="m", lower=0.0, upper=1.0, doc="height of the object's frame over the plate"
    )
    center_of_mass: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), unit="m", lower=-1.0, upper=1.0, length=3, doc="in the object's frame"
    )
    foot: tuple[float, ...] = setting(
        (0.0285, 0.0285), unit="m", lower=1e-4, upper=1.0, length=2,
        doc="half extent along x and y of what stands on the plate",
    )  # fmt: skip
    plate: tuple[float, ...] = setting(
        (0.06, 0.06), unit="m", lower=1e-3, upper=1.0, length=2, doc="half extent of the plate along x and y"
    )
    friction_plate: float = setting(1.0, lower=0.0, upper=5.0, doc="between object and plate")
    rim_deg: float = setting(
        0.0, unit="deg", lower=0.0, upper=80.0, doc="slope of the plate at its edge: 0 flat, above concave"
    )
    stiffness: float = setting(
        1.6e4, unit="N/m", lower=1.0, upper=1e9, doc="of object and pads along the plate's normal"
    )
    hand_time: float = setting(
        2.0, unit="s", lower=0.0, upper=60.0, doc="after the first touch, until the hand lets go"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        steepest = math.degrees(math.atan(self.friction_plate)) + self.rim_deg
        if steepest > _STEEPEST_DEG:
            raise SettingError(
                f"friction_plate = {self.friction_plate:g} and rim_deg = {self.rim_deg:g}: the cone opens to "
                f"{steepest:.1f} degrees, must be at most {_STEEPEST_DEG:g}"
            )

    secant_stiffness = SkinForces.mindlin_stiffness

    @property
    def friction(self) -> float:
        """Of the plate, with the rim that the object would have to climb."""
        return math.tan(math.atan(self.friction_plate) + math.radians(self.rim_deg))


@dataclass(frozen=True)
class HeldLoad:
    """What the plate has to carry.

    Attributes
    ----------
    force : ndarray (3,)
        Weight and the tip's force together, N, in the plate's frame.
    pressure : ndarray (2,)
        Center of pressure on the plate, m.
    torsion : float
        Torque of both about the plate's normal through the center of pressure, N m.
    slip, tilt : float
        Load over what friction and foot can carry: 1 at the limit.
    """

    force: Array
    pressure: Array
    torsion: float
    slip: float
    tilt: float

    @property
    def margin(self) -> float:
        """What is left of the tighter condition: 1 without load, 0 at the limit, negative beyond."""
        return 1.0 - max(self.slip, self.tilt)


class HeldObject:
    """One object with its place on the plate."""

    def __init__(self, settings: HeldSettings | None = None) -> None:
        self.settings = settings or HeldSettings()
        self.state = HeldState.BY_HAND
        self.load: HeldLoad | None = None  # of the last step without the hand
        self._hand = self.settings.hand_time
        self._touched = False
        self._offset = np.zeros(3)  # over the plate: x, y (m) and turn (rad)
        self._speed = 0.0  # m/s over the plate
        self._tilted = np.zeros(2)  # rad, towards x and y
        self._yield = 0.0  # m

    @property
    def T_plate_object(self) -> Array:
        """Pose (4, 4) of the object's frame in the plate's; of a fallen one, where it was last."""
        x, y, turn = self._offset
        cos, sin = math.cos(turn), math.sin(turn)
        T = np.eye(4)
        T[:2, :2] = [[cos, -sin], [sin, cos]]
        T[:3, 3] = x, y, self.settings.standoff - self._yield
        if not self._tilted.any():
            return T
        middle, half = self._support()
        edge = np.array([*(middle + np.sign(self._tilted) * half), 0.0])
        about = se3.exp([0.0, 0.0, 0.0, -self._tilted[1], self._tilted[0], 0.0])
        about[:3, 3] = edge - about[:3, :3] @ edge
        return np.asarray(about @ T)

    def step(
        self,
        T_world_plate: Array,
        force: Array,
        point: Array,
        dt: float,
        gravity: Sequence[float] = GRAVITY,
    ) -> Array:
        """Hold, slip or fall for `dt` seconds, and return `T_plate_object` (4, 4).

        Parameters
        ----------
        T_world_plate : ndarray (4, 4)
        force, point : ndarray (3,)
            Force of the tip on the object (N), zero without contact, and where it acts (m), in the plate's
            frame. Each must be newer than the step before: yielding and slipping change it.
        gravity : (3,)
            m/s^2, in the world.
        """
        if self.state is HeldState.FALLEN:
            return self.T_plate_object
        self._comply(max(0.0, -float(force[2])))
        if self._in_hand(force, dt):
            return self.T_plate_object
        weight = self.settings.mass * (T_world_plate[:3, :3].T @ np.asarray(gravity, dtype=float))
        self.load = self._load(weight, force, point)
        self._move(self.load, force, point, dt)
        return self.T_plate_object

    def _move(self, load: HeldLoad, force: Array, point: Array, dt: float) -> None:
        if load.force[2] >= 0 or not self._rock(load, force, point):
            self.state = HeldState.FALLEN
        elif load.slip > 1:
            self.state = HeldState.SLIPPING
            self._slide(load, force, dt)
        else:
            self.state = HeldState.ROCKING if self._tilted.any() else HeldState.STICKING
            self._speed = 0.0

    def _in_hand(self, force: Array, dt: float) -> bool:
        """Whether the hand still holds it: from the first touch on for `hand_time`."""
        if self._touched:
            self._hand -= dt
        self._touched = self._touched or bool(np.any(force))
        return not self._touched or self._hand > 0

    def _comply(self, press: float) -> None:
        """Yield by a Newton step towards stiffness x yield = press, as if the tip stood still."""
        s = self.settings
        depth = s.depth(press)
        skin = s.normal_stiffness(depth, press)
        self._yield = max(0.0, self._yield + (press - s.stiffness * self._yield) / (s.stiffness + skin))

    def _load(self, weight: Array, force: Array, point: Array) -> HeldLoad:
        s, T = self.settings, self.T_plate_object
        center = T[:3, :3] @ np.array(s.center_of_mass) + T[:3, 3]
        total = weight + force
        moment = np.cross(center, weight) + np.cross(point, force)
        press = -float(total[2])
        if press <= 0:
            return HeldLoad(total, np.zeros(2), 0.0, math.inf, math.inf)
        pressure = np.array([moment[1], -moment[0]]) / press
        torsion = float(moment[2] - (pressure[0] * total[1] - pressure[1] * total[0]))
        limit = s.friction * press
        sheared = math.hypot(float(total[0]), float(total[1]), torsion / float(np.mean(s.foot)))
        slip = sheared / limit if limit > 0 else (math.inf if sheared > 0 else 0.0)
        middle, half = self._support()
        tilt = float(np.max(np.abs(pressure - middle) / half)) if (half > 0).all() else math.inf
        return HeldLoad(total, pressure, torsion, slip, tilt)

    def _support(self) -> tuple[Array, Array]:
        """Middle and half extent (2,) m of what of the foot is on the plate; not positive if it is off."""
        foot, plate = np.array(self.settings.foot), np.array(self.settings.plate)
        low, high = np.maximum(self._offset[:2] - foot, -plate), np.minimum(self._offset[:2] + foot, plate)
        return (low + high) / 2, (high - low) / 2

    def _rock(self, load: HeldLoad, force: Array, point: Array) -> bool:
        """Turn about the edge of the foot by what lets the skin take the moment; False if that is too far.

        Turning by an angle shears the skin by the height of the tip over the plate times it, lets the press
        act as much nearer the middle, and presses deeper by the tip's distance from the edge times it.
        """
        s, height, press = self.settings, float(point[2]), max(0.0, -float(force[2]))
        middle, half = self._support()
        if not (half > 0).all():
            return False
        side = np.where(self._tilted != 0, self._tilted, load.pressure - middle)
        side = np.where(side < 0, -1.0, 1.0)
        moment = -load.force[2] * (side * (load.pressure - middle) - half)
        if not (self._tilted.any() or (moment > 0).any()):
            return True
        depth = s.depth(press)
        shear = 0.0 if self._tip_slips(force) else s.shear_stiffness(depth)
        normal = s.normal_stiffness(depth, press)
        lever = side * (point[:2] - middle) - half
        stiffness = (shear * height + press) * height + normal * lever**2
        if (stiffness <= 0).any():
            return False
        self._tilted = side * np.maximum(0.0, side * self._tilted + moment / stiffness)
        return bool((np.abs(self._tilted) < _TOPPLED).all())

    def _tip_slips(self, force: Array) -> bool:
        """Whether the tip's force across the plate's normal grows no more."""
        return math.hypot(force[0], force[1]) >= _TIP_SLIPS * self.settings.friction_tip * -float(force[2])

    def _slide(self, load: HeldLoad, force: Array, dt: float) -> None:
        """Move by what stretches the skin until it carries the excess, within what inertia allows."""
        s, press = self.settings, max(0.0, -float(force[2]))
        excess = 1.0 - 1.0 / load.slip
        along = float(np.hypot(load.force[0], load.force[1]))
        length = (self._speed + excess * along / s.mass * dt) * dt
        stiffness = s.shear_stiffness(s.depth(press))
        if stiffness > 0 and not self._tip_slips(force):
            length = min(length, excess * along / stiffness)
        if along > 0:
            # the normal of the limit surface: torsion over the square of its lever turns as force moves
            lever = float(np.mean(s.foot))
            self._offset += length / along * np.array([*load.force[:2], load.torsion / lever**2])
        elif stiffness > 0:
            self._offset[2] += excess * load.torsion / (stiffness * float(np.mean(s.foot)) ** 2)
        self._speed = length / dt


class Held:
    """The motion `held` of a body: the arm that it is `carried_by` has the plate."""

    settings_class: ClassVar[type[Settings]] = HeldSettings

    def __init__(self, scene: Scene, body: BodyScene, settings: HeldSettings) -> None:
        if not body.carried_by:
            raise SettingError(f"body '{body.name}': motion 'held' needs carried_by, the arm with the plate")
        self.carriers = (body.carried_by,)
        self.object = HeldObject(settings)
        self._T_tool_plate = body.T_parent_body @ se3.inverse(self.object.T_plate_object)
        self._newest = -1  # stamp of the contact that the object has felt last, ns
        self._since = 0.0  # s since then
        self._fallen = 0.0  # s since it fell
        self._outward = np.zeros(3)  # of the plate, in the world
        self._T_world_body = scene.T_world_body(body.name)

    def step(self, dt: float, tools: Mapping[str, Array], contacts: Sequence[BodyContact]) -> Array:
        """T_world_body (4, 4): on the plate, or on the floor."""
        if self.object.state is HeldState.FALLEN:
            self._fallen += dt
            T = self._T_world_body.copy()
            T[:3, 3] -= _ASIDE * self._outward if self._fallen < _ASIDE_FOR else [0.0, 0.0, _FLOOR]
            return T
        self._since += dt
        T_world_plate = tools[self.carriers[0]] @ self._T_tool_plate
        newest = max((contact.stamp_ns for contact in contacts), default=-1)
        if newest < 0 or newest != self._newest:
            force, point = self._pressed(contacts)
            self.object.step(T_world_plate, force, point, self._since)
            self._newest, self._since = newest, 0.0
        self._T_world_body, self._outward = T_world_plate @ self.object.T_plate_object, T_world_plate[:3, 2]
        return self._T_world_body

    def _pressed(self, contacts: Sequence[BodyContact]) -> tuple[Array, Array]:
        """Force of all sensors on the object, and the point where it acts, in the plate's frame."""
        force, point, sizes, T = np.zeros(3), np.zeros(3), 0.0, self.object.T_plate_object
        for contact in contacts:
            known = self.object.settings.force_on_body(contact)
            size = float(np.linalg.norm(known))
            force += T[:3, :3] @ known
            point += size * (T[:3, :3] @ self.object.settings.point_on_body(contact) + T[:3, 3])
            sizes += size
        return force, point / sizes if sizes > 0 else point
