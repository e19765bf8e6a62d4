"""The label chain against transforms3d and SciPy's matrix logarithm."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm, logm
from tangent import hat, vee
from transforms3d.affines import compose
from transforms3d.euler import euler2mat

from tactile_perception.estimating import labels

LENGTHS = st.floats(-6.0, 6.0)
ANGLES = st.floats(-30.0, 30.0)
POSES = st.tuples(LENGTHS, LENGTHS, LENGTHS, ANGLES, ANGLES, ANGLES).map(np.array)


def reference_label(euler: np.ndarray) -> np.ndarray:
    """The paper's three steps, in millimeters all the way."""
    X_fs = compose(euler[:3], euler2mat(*np.radians(euler[3:]), axes="sxyz"), np.ones(3))
    return vee(logm(np.linalg.inv(X_fs)).real)


@given(POSES)
def test_label_is_the_logarithm_of_the_inverse_pose(euler):
    np.testing.assert_allclose(labels.label_from_euler(euler), reference_label(euler), rtol=0, atol=1e-9)


@given(POSES)
def test_pose_of_a_network_vector_is_its_exponential_in_metres(euler):
    xi = reference_label(euler)
    meters = np.concatenate([xi[:3] * 1e-3, xi[3:]])
    np.testing.assert_allclose(labels.pose_from_network(xi), expm(hat(meters)), rtol=0, atol=1e-12)


@given(POSES)
def test_euler_pose_survives_the_way_there_and_back(euler):
    np.testing.assert_allclose(
        labels.euler_from_label(labels.label_from_euler(euler)), euler, rtol=0, atol=1e-8
    )


@given(POSES)
def test_network_vector_survives_the_way_through_the_pose(euler):
    xi = labels.label_from_euler(euler)
    np.testing.assert_allclose(labels.network_from_pose(labels.pose_from_network(xi)), xi, atol=1e-9)


def test_pure_depth_is_a_surface_nearer_along_minus_z():
    """Pressing 3 mm in moves the surface 3 mm towards the sensor: rho_z = -3 mm."""
    np.testing.assert_allclose(
        labels.label_from_euler([0, 0, 3.0, 0, 0, 0]), [0, 0, -3.0, 0, 0, 0], atol=1e-12
    )


def test_euler_angles_are_extrinsic_xyz():
    T = labels.surface_contact_pose([0, 0, 0, 20.0, -15.0, 4.0])
    np.testing.assert_allclose(T[:3, :3], euler2mat(*np.radians([20.0, -15.0, 4.0]), axes="sxyz"), atol=1e-12)
    np.testing.assert_allclose(labels.euler_from_pose(T), [0, 0, 0, 20.0, -15.0, 4.0], atol=1e-9)


def test_rows_are_converted_one_by_one():
    rows = np.random.default_rng(0).uniform(-5, 5, (4, 6))
    np.testing.assert_allclose(
        labels.labels_from_euler(rows), [reference_label(row) for row in rows], atol=1e-9
    )
    assert labels.labels_from_euler(np.empty((0, 6))).shape == (0, 6)


def test_a_row_of_the_wrong_length_is_refused():
    with pytest.raises(ValueError, match=r"must have the shape \(6,\), has \(5,\)"):
        labels.label_from_euler(np.zeros(5))
