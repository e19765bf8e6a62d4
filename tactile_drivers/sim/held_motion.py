"""The motion `held`: a body that an arm's plate carries while tips press it (`tactile_drivers.sim.held`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings
from tactile_drivers.sim.held import HeldObject, HeldSettings, HeldState
from tactile_filter import se3

if TYPE_CHECKING:
    from tactile_drivers.scene import BodyScene, Scene
    from tactile_drivers.sim.motions import BodyContact

Array = NDArray[np.float64]

# A fallen object is out of the tip's reach at once, along the plate's normal: the quasi-static skin could not
# push it aside while it falls past. After some exposures it lies on the floor.
_ASIDE, _ASIDE_FOR = 0.1, 0.5  # m, s
_FLOOR = 1.0  # m below


class Held:
    """The motion of a held body: the arm that it is `carried_by` has the plate."""

    settings_class: ClassVar[type[Settings]] = HeldSettings

    def __init__(self, scene: Scene, body: BodyScene, settings: HeldSettings) -> None:
        if not body.carried_by:
            raise SettingError(f"body '{body.name}': motion 'held' needs carried_by, the arm with the plate")
        self.carriers = (body.carried_by,)
        self.object = HeldObject(settings)
        self._surface = body.make()
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
            known = contact.force if np.isfinite(contact.force).all() else self._by_curve(contact)
            size = float(np.linalg.norm(known))
            force += T[:3, :3] @ known
            touched = self._surface.closest(contact.T_body_sensor[None, :3, 3])[0]
            point += size * (T[:3, :3] @ touched + T[:3, 3])
            sizes += size
        return force, point / sizes if sizes > 0 else point

    def _by_curve(self, contact: BodyContact) -> Array:
        """Force (3,) on the body, in its frame, of a sensor that models none: from depth and shear."""
        s, depth = self.object.settings, contact.truth.depth
        press = s.normal_force(depth)
        shear = s.shear_stiffness(depth) * contact.truth.T_fs[:2, 3]
        limit, size = s.friction_tip * press, float(np.linalg.norm(shear))
        if size > limit:
            shear = shear * (limit / size)
        return contact.T_body_sensor[:3, :3] @ contact.truth.T_fs[:3, :3].T @ np.array([*shear, press])
