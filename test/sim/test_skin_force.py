"""The largest shear of a simulated tip by a formula is that at which its simulation slides."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tactile_geometry import se3
from tactile_scene.shapes import make_surface
from tactile_scene.shapes.surface import contact_pose
from tactile_scene.simulated_sensors import IdealSensorSettings, TacTipSettings
from tactile_sim.ideal_sensor import IdealSensor
from tactile_sim.sensor import contact_on_body
from tactile_sim.skin_force import STAYS, SkinForces, largest_shear
from tactile_sim.tactip import TacTip

MM = 1e-3
PLANE = make_surface("plane", {})
DOWN = se3.pose_from_euler([0.0, 0.0, 0.020, np.pi, 0.0, 0.0])


def dragged(sensor: TacTip | IdealSensor, depth: float, way: float) -> float:
    """Shear (m) after the sensor was pressed on the plane and dragged along it."""
    shifts = ((0.0, -MM), (0.0, depth), *((x, depth) for x in np.linspace(0.0, way, 40)))
    for x, z in shifts:
        sensor.advance(PLANE, DOWN @ se3.pose_from_euler([x, 0.0, z, 0.0, 0.0, 0.0]))
    return float(np.linalg.norm(sensor.truth().T_fs[:2, 3]))


@pytest.mark.parametrize(
    ("friction", "load", "modulus"), [(0.9, 0.0, 8e3), (0.5, 0.0, 8e3), (1.2, 0.0, 4e4), (0.9, 0.5, 8e3)]
)
@pytest.mark.parametrize("depth", [MM, 3 * MM, 6 * MM])
def test_a_soft_tip_is_sheared_as_far_as_is_said_and_no_further(friction, load, modulus, depth):
    model = TacTipSettings()
    model = replace(
        model,
        contact=model.contact.replaced(friction=friction, friction_load=load),
        skin=model.skin.replaced(gel_modulus=modulus),
    )
    limit = largest_shear(model, depth)
    assert dragged(TacTip(model), depth, 2 * limit) == pytest.approx(limit, rel=0.15)


@pytest.mark.parametrize("depth", [4 * MM, 6 * MM, 8 * MM])
@pytest.mark.parametrize("way", [(2 * MM, 0.0), (-1.5 * MM, 3 * MM)])
def test_a_sheared_tip_goes_on_pressing_where_it_touched(depth, way):
    """The simulated skin's own centre of pressure, against that of a sensor that models no force."""
    sensor, turned = TacTip(), se3.pose_from_euler([0.0, 0.0, 0.0, 0.0, 0.0, 0.7])
    for x, y, z in ((0.0, 0.0, -MM), (0.0, 0.0, depth), (*way, depth)):
        T = DOWN @ se3.pose_from_euler([x, y, z, 0.0, 0.0, 0.0]) @ turned
        sensor.advance(PLANE, T)
    geometry, known = contact_pose(PLANE, T, 0.020), sensor.truth()
    truth = SimpleNamespace(T_fs=known.T_fs, depth=depth)
    felt = contact_on_body("arm", 0, geometry, T, truth, known)
    assert SkinForces().point_on_body(felt) is felt.point
    guessed = SkinForces().point_on_body(replace(felt, point=geometry.point, force=np.full(3, np.nan)))
    shear = np.hypot(*way)
    assert np.linalg.norm(geometry.point - felt.point) == pytest.approx(STAYS * shear, rel=0.1)
    assert np.linalg.norm(guessed - felt.point) < 0.12 * shear


def test_an_ideal_sensor_is_sheared_to_just_there():
    model = IdealSensorSettings()
    limit = largest_shear(model, 2.5 * MM)
    assert dragged(IdealSensor(model), 2.5 * MM, 2 * limit) == pytest.approx(limit, rel=1e-6)


def test_of_a_skin_that_was_not_measured_nothing_is_said_and_without_contact_there_is_no_shear():
    model = TacTipSettings()
    assert largest_shear(replace(model, skin=model.skin.replaced(stiffness_ratio=4.0)), 3 * MM) is None
    assert largest_shear(model, -MM) == 0.0 == largest_shear(IdealSensorSettings(), -MM)


def thick_layer(depth: float, radius: float, modulus: float, poisson: float) -> float:
    """Hertz's force on a sphere, with the correction for a layer as thick that is bonded at its back.

    Dimitriadis, Horkay, Maresca, Kachar, Chadwick, "Determination of elastic moduli of thin layers of soft
    material using the atomic force microscope", Biophysical Journal 82 (2002), eq. 12.
    """
    a = -(1.2876 - 1.4678 * poisson + 1.3442 * poisson**2) / (1.0 - poisson)
    b = (0.6387 - 1.0277 * poisson + 1.5164 * poisson**2) / (1.0 - poisson)
    x = np.sqrt(radius * depth) / radius / np.pi
    correction = (
        1.0 - 2.0 * a * x + 4.0 * a**2 * x**2 - 8.0 * (a**3 + 4.0 * np.pi**2 / 15.0 * b) * x**3
        + 16.0 * a * (a**3 + 3.0 * np.pi**2 / 5.0 * b) * x**4
    )  # fmt: skip
    return 4.0 / 3.0 * modulus / (1.0 - poisson**2) * np.sqrt(radius) * depth**1.5 * correction


def test_the_normal_force_of_a_tip_of_gel_alone_is_that_of_contact_mechanics():
    """Without a skin and friction, where the contact is wider than the mesh and small against the tip."""
    model = TacTipSettings()
    model = replace(
        model,
        skin=model.skin.replaced(stiffness_ratio=1.0),
        contact=model.contact.replaced(friction=0.0, max_sweeps=3000, tolerance=1e-9),
    )
    sensor = TacTip(model)
    sensor.advance(PLANE, DOWN @ se3.pose_from_euler([0.0, 0.0, -MM, 0.0, 0.0, 0.0]))
    for depth in (0.5 * MM, 0.8 * MM, MM, 1.5 * MM, 2 * MM):
        sensor.advance(PLANE, DOWN @ se3.pose_from_euler([0.0, 0.0, depth, 0.0, 0.0, 0.0]))
        expected = thick_layer(depth, 0.020, model.skin.gel_modulus, model.skin.poisson_ratio)
        assert sensor.truth().normal_force == pytest.approx(expected, rel=0.1)
