"""Arrays of the plane against what they stand for: C's limit surface, shapes, Ruckig, `numpy.interp`."""

import numpy as np
import pytest

from tactile_base.array_math import array_math
from tactile_base.settings import SettingError
from tactile_scene.arm_settings import ArmLimits
from tactile_scene.shapes.box import Box, BoxSettings
from tactile_scene.shapes.cylinder import Cylinder, CylinderSettings
from tactile_scene.shapes.dome import Dome
from tactile_scene.shapes.prism import Prism, PrismSettings
from tactile_scene.twist_profile import TwistProfile
from tactile_sim import limit_surface
from tactile_sim.plane_body import Outlines, returned
from tactile_sim.plane_cell import profile, table

NUMPY = array_math()
SHAPES = (
    Box(BoxSettings(size=(0.095, 0.058, 0.19), rounding=0.010)),
    Prism(PrismSettings(sides=6, width=0.07)),
    Prism(PrismSettings(sides=5, width=0.07, rounding=0.004)),
    Cylinder(CylinderSettings(radius=0.04)),
)


def test_outlines_are_those_of_the_shapes():
    random = np.random.default_rng(1)
    for shape in SHAPES:
        places = random.uniform(-0.09, 0.09, (400, 2))
        distance, normal = shape.query(np.column_stack([places, np.zeros(400)]))
        outside = distance > 0.002
        outlines = Outlines.of([shape] * 400, NUMPY)
        found, direction = outlines.nearest(places[:, 0] + 1j * places[:, 1], NUMPY)
        np.testing.assert_allclose(found[outside], distance[outside], atol=1e-12)
        np.testing.assert_allclose(direction[outside], normal[outside] @ [1.0, 1j, 0.0], atol=1e-9)


def test_shapes_that_are_no_prisms_are_refused():
    with pytest.raises(SettingError, match="it knows boxes, prisms and upright cylinders, not dome"):
        Outlines.of([Dome()], NUMPY)


@pytest.mark.parametrize("stiffness", [1.0, 1e3, 1e6])
def test_loads_return_to_the_limit_surface_as_in_c(stiffness):
    random = np.random.default_rng(2)
    loads, roots = 2.0 * random.standard_normal((100, 3)), random.standard_normal((100, 3, 3))
    matrices = stiffness * np.einsum("nij,nkj->nik", roots, roots)
    upper = [matrices[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))]
    motion, _ = returned(list(loads.T), upper, NUMPY)
    for found, load, matrix in zip(np.stack(motion, 1), loads, matrices, strict=True):
        if load @ load > 1.0:
            expected, _ = limit_surface.return_to_surface(load, matrix, 1.0, 1.0)
            np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-15)


def test_arms_move_as_ruckig_says():
    limits, random = ArmLimits(), np.random.default_rng(3)
    twins = [TwistProfile(limits) for _ in range(20)]
    most = np.array([[limits.linear_acceleration]] * 3 + [[limits.angular_acceleration]])
    jerk = np.array([[limits.linear_jerk]] * 3 + [[limits.angular_jerk]])
    speed = growth = np.zeros((4, 20))
    for step in range(60):
        if step % 3 == 0:  # also small changes, and while the last one is under way
            scale = np.array([[0.05], [0.01], [0.001], [0.5]]) * random.choice([0.0, 0.1, 1.0], 20)
            target = scale * random.standard_normal((4, 20))
        way, speed, growth = profile(speed, growth, target, 1.0 / 120.0, most, jerk, NUMPY)
        for k, twin in enumerate(twins):
            moved = twin.advance(1.0 / 120.0, np.array([*target[:3, k], target[3, k], 0.0, 0.0]))
            np.testing.assert_allclose(way[:, k], moved[:4], atol=1e-9)
            np.testing.assert_allclose(speed[:, k], twin.twist[:4], atol=1e-7)


def test_tables_are_looked_up_as_numpy_does():
    at, values = np.array([0.0, 1.0, 3.0]), np.array([0.5, 2.0, -1.0])
    x = np.linspace(-1.0, 4.0, 50)
    np.testing.assert_allclose(table(x, at, values, NUMPY), np.interp(x, at, values), atol=1e-14)


@pytest.mark.parametrize("name", ["cupy", "numpy:gpu", "torch:nowhere"])
def test_a_device_that_is_not_there_is_told(name):
    with pytest.raises(SettingError, match=f"device {name}: "):
        array_math(name)
