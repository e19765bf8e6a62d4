"""Samples on curved surfaces: labels mean what they mean on a plane."""

import numpy as np
import pytest

from tactile_geometry import se3
from tactile_sim.collection import CollectionSettings, generate, press_then_shear
from tactile_sim.tactip import TacTip

POSE = np.array([5e-4, -3e-4, 4e-3, 0.1, -0.2, 0.02])


@pytest.fixture(scope="module")
def sensor() -> TacTip:
    return TacTip()


def contact(sensor: TacTip, curvature: float):
    sensor.reset(seed=1)
    sensor.friction = 1.2
    press_then_shear(sensor, POSE, curvature=curvature)
    return sensor.truth()


@pytest.mark.parametrize("curvature", [0.0, 1e-3, 13.0, 30.0, -5.0, -15.0])
def test_the_truth_is_the_pose_asked_for(sensor, curvature):
    truth = contact(sensor, curvature)
    expected = se3.pose_from_euler(POSE)
    assert truth.depth == pytest.approx(POSE[2], abs=1e-9)
    np.testing.assert_allclose(truth.T_fs[:3, 3], expected[:3, 3], atol=3e-5)
    np.testing.assert_allclose(truth.T_fs[:3, :3], expected[:3, :3], atol=2e-3)


def test_a_rounder_surface_is_pressed_with_less_force(sensor):
    forces = [contact(sensor, curvature).normal_force for curvature in (-10.0, 0.0, 10.0, 20.0)]
    assert np.all(np.diff(forces) < 0.0)


def test_a_plane_is_the_limit_of_spheres(sensor):
    flat = contact(sensor, 0.0)
    nearly = contact(sensor, 1e-4)
    np.testing.assert_allclose(nearly.force, flat.force, rtol=2e-3, atol=1e-3)


def test_curvature_changes_images_but_not_labels():
    flat, curved = (
        next(generate(CollectionSettings(curvature=range_), 1, [0])) for range_ in ((0.0, 0.0), (15.0, 15.0))
    )
    np.testing.assert_array_equal(flat.euler_mm_deg, curved.euler_mm_deg)
    assert flat.friction == curved.friction
    assert np.mean(flat.image != curved.image) > 0.01
