"""How stiff a tip's skin is, and its force from depth and shear for a sensor that does not model it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import Settings, setting
from tactile_scene.simulated_sensors import IdealSensorSettings, SkinSettings, TacTipSettings
from tactile_sim import _contact

if TYPE_CHECKING:
    from tactile_sim.motions import BodyContact

Array = NDArray[np.float64]

SkinModel = TacTipSettings | IdealSensorSettings

REFERENCE_DEPTH = 6e-3  # m, of the skin's two curves: the depth that the paper holds objects at
STAYS = 0.85  # of the shear: so far behind the dome's centre a skin that sticks goes on pressing


@dataclass(frozen=True)
class SkinForces(Settings):
    """Normal force and shear stiffness over depth as powers, and friction.

    The curves are fitted to the simulated TacTip on a plane by bench/simulation/skin_curves.py; they scale
    with `SkinSettings.gel_modulus`.
    """

    friction_tip: float = setting(0.9, lower=0.0, upper=5.0, doc="between object and the tip's skin")
    skin_force: float = setting(
        1.69, unit="N", lower=0.0, upper=1e4, doc="normal force of the tip at a depth of 6 mm"
    )
    skin_exponent: float = setting(1.68, lower=1.0, upper=3.0, doc="of the normal force over depth")
    skin_shear: float = setting(
        211.0, unit="N/m", lower=0.0, upper=1e7, doc="of the tip, tangential, at 6 mm"
    )
    skin_shear_exponent: float = setting(0.47, lower=0.0, upper=3.0, doc="of that stiffness over depth")

    def normal_force(self, depth: float) -> float:
        """Of the tip (N) at a depth (m) of its skin."""
        return self.skin_force * max(depth / REFERENCE_DEPTH, 0.0) ** self.skin_exponent

    def normal_stiffness(self, depth: float, force: float) -> float:
        """Of the tip's skin along the normal (N/m) at a depth (m) where it presses with a force (N)."""
        return self.skin_exponent * force / depth if depth > 0 else 0.0

    def shear_stiffness(self, depth: float) -> float:
        """Of the tip's skin across the normal (N/m) at a depth (m)."""
        return self.skin_shear * max(depth / REFERENCE_DEPTH, 0.0) ** self.skin_shear_exponent

    def secant_stiffness(self, depth: float, shear: float) -> float:
        """Tangential force over shear (N/m) at a depth and a shear (m); here the same at any shear."""
        return self.shear_stiffness(depth)

    def mindlin_stiffness(self, depth: float, shear: float) -> float:
        """That where the rim of the contact slips first: F = mu P (1 - (1 - 2 k s / (3 mu P))^(3/2)).

        R. D. Mindlin, Compliance of elastic bodies in contact, J. Appl. Mech. 16 (1949) 259-268. It is within
        6 % of the simulated TacTip's.
        """
        stiffness, limit = self.shear_stiffness(depth), self.friction_tip * self.normal_force(depth)
        if shear <= 0.0 or limit <= 0.0:
            return stiffness
        left = max(0.0, 1.0 - 2.0 * stiffness * shear / (3.0 * limit))
        return limit * (1.0 - left**1.5) / shear

    def depth(self, normal_force: float) -> float:
        """Of the tip (m) at a normal force (N)."""
        if normal_force <= 0 or self.skin_force == 0:
            return 0.0
        return REFERENCE_DEPTH * float((normal_force / self.skin_force) ** (1 / self.skin_exponent))

    def force_on_body(self, contact: BodyContact) -> Array:
        """Force (3,) N of a sensor on the body, in its frame: what it models, else by depth and shear."""
        if not math.isnan(contact.force[0]):
            return contact.force
        depth, T_fs = contact.truth.depth, contact.truth.T_fs
        press, stiffness = self.normal_force(depth), self.secant_stiffness(depth, math.hypot(*T_fs[:2, 3]))
        return _contact.skin_force(contact.T_body_sensor, T_fs, press, stiffness, self.friction_tip)

    def point_on_body(self, contact: BodyContact) -> Array:
        """Where that force acts (3,), m, in the body's frame: what sticks presses where it touched."""
        if not math.isnan(contact.force[0]):
            return contact.point
        T_fs = contact.truth.T_fs
        x, y, _ = T_fs[:3, 3]
        R = contact.T_body_sensor[:3, :3] @ T_fs[:3, :3].T
        return np.asarray(contact.point - STAYS * (x * R[:, 0] + y * R[:, 1]))


def largest_shear(model: SkinModel, depth: float) -> float | None:
    """Shear (m) beyond which a simulated tip slides at a depth (m); None for a skin that nobody has measured.

    That of an image sensor is within 15 % of what it does on a plane (test/sim/test_skin_force.py): parts of
    the contact slip before, and on other surfaces it differs.
    """
    if isinstance(model, IdealSensorSettings):
        return float(np.interp(depth, model.shear_depths, model.shear_limits))
    measured, contact = SkinSettings(), model.contact
    if model.skin.replaced(gel_modulus=measured.gel_modulus) != measured:
        return None
    if depth <= 0.0:
        return 0.0
    skin = SkinForces()
    press = skin.normal_force(depth)
    load = press * model.skin.gel_modulus / measured.gel_modulus
    return contact.friction * load / (load + contact.friction_load) * press / skin.shear_stiffness(depth)
