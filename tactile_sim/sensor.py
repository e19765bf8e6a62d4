"""The sensor of a simulated arm: its model, what it answers, and what the touched body feels of it."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tactile_geometry.gaussian import PoseGaussian
from tactile_scene.shapes.surface import ContactGeometry, Surface, contact_pose
from tactile_scene.simulated_sensors import FittedSensorSettings, SkinSettings, TacTipSettings
from tactile_scene.simulation import SimulatedSensor
from tactile_sim.body import TouchedBody
from tactile_sim.fitted_sensor import FittedSensor
from tactile_sim.frame import Truth
from tactile_sim.ideal_sensor import IdealSensor, IdealTruth
from tactile_sim.motions import BodyContact

if TYPE_CHECKING:
    from tactile_sim.network_view import ViewSettings
    from tactile_sim.skin import Skin
    from tactile_sim.tactip import ContactTruth, TacTip

Array = NDArray[np.float64]


class Sensor:
    """A TacTip, whose answer is an image, or an ideal sensor, whose answer is an estimate."""

    def __init__(self, sensor: SimulatedSensor, seed: int, view: ViewSettings | None) -> None:
        self.radius = sensor.tip_radius
        self.model: TacTip | IdealSensor
        if isinstance(sensor.model, TacTipSettings):
            from tactile_sim.tactip import TacTip  # needs the compiled contact solver

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

    def answer(self, in_contact: bool) -> tuple[NDArray[np.uint8] | None, PoseGaussian | None, float]:
        """Image, estimate and plain depth (m), as `Frame` holds them."""
        if isinstance(self.model, IdealSensor):
            estimate = self.model.estimate() if in_contact else None
            return None, estimate, self.model.plain_depth() if in_contact else math.nan
        return self.model.image(), None, math.nan


@functools.cache
def _skin(settings: SkinSettings) -> Skin:
    """The condensed skin, which several sensors share; nothing writes to it."""
    from tactile_sim.skin import load_skin

    return load_skin(settings)


def contact_on_body(
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


def true_contact(target: TouchedBody, geometry: ContactGeometry, known: ContactTruth | IdealTruth) -> Truth:
    """What the sensor's model knows, with the geometry of the surface in the arm's base."""
    return Truth(
        surface=target.body.name,
        in_contact=known.contact_nodes > 0,
        depth=geometry.depth,
        normal_angle=geometry.normal_angle,
        T_fs=known.T_fs,
        slip_fraction=known.slip_fraction,
        normal_force=known.normal_force,
        force=known.force,
        nearest=geometry.point,
        outward=geometry.normal,
        T_base_body=target.T_base_body,
    )
