"""SE(3) against 60 digits written from the definitions, SciPy, transforms3d, and the group's laws."""

import math

import mpmath as mp
import numpy as np
import pytest
import se3_oracle as oracle
import se3_reference as plain
import transforms3d
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tactile_geometry import se3

# From nothing over where series and closed forms meet to a half turn.
ANGLES = [0.0, 1e-300, 1e-160, 1e-12, 1e-9, 1e-7, 1e-4, 0.01, 0.3, 1.0, 1.7, 2.5, 3.0]
ANGLES += [math.pi - 1e-3, math.pi - 1e-7, math.pi - 1e-9, math.pi]
BEYOND_PI = [3.2, 4.0, 5.0, 6.0, 2 * math.pi - 1e-3]
EPS = 2.0**-52


def tangent(angle, seed, length=1.0):
    rng = np.random.default_rng(seed)
    axis, rho = rng.normal(size=(2, 3))
    return np.concatenate((length * rho, axis / np.linalg.norm(axis) * angle))


def clamp_angle(xi, limit=math.pi - 1e-6):
    xi = np.array(xi)
    angle = np.linalg.norm(xi[3:])
    xi[3:] *= min(1.0, limit / angle) if angle else 1.0
    return xi


def vectors(limit=math.pi - 1e-6):
    element = st.floats(-3.0, 3.0, allow_subnormal=False)
    return st.lists(element, min_size=6, max_size=6).map(lambda v: clamp_angle(v, limit))


@pytest.mark.parametrize("angle", ANGLES + BEYOND_PI)
def test_exp_is_the_power_series_to_rounding(angle):
    for seed in range(3):
        xi = tangent(angle, seed)
        reference = oracle.exp(xi)
        T = se3.exp(xi)
        assert oracle.worst(reference[:3, :3], T[:3, :3]) <= 2.5 * EPS * max(1.0, angle)
        translation = np.abs(xi[:3]).max() * max(1.0, angle)
        assert oracle.worst(reference[:3, 3], T[:3, 3:]) <= 4 * EPS * translation


@pytest.mark.parametrize("length", [1e-9, 1.0, 1e6])
@pytest.mark.parametrize("angle", ANGLES[:-1])
def test_log_inverts_the_power_series(angle, length):
    for seed in range(3):
        xi = tangent(angle, seed, length)
        found = se3.log(oracle.as_double(oracle.exp(xi)))
        # near a half turn the rounding of the matrix itself moves the axis by this much
        assert np.abs(found[3:] - xi[3:]).max() <= 4 * EPS * angle
        assert np.abs(found[:3] - xi[:3]).max() <= 16 * EPS * np.linalg.norm(xi[:3])


def test_log_of_a_tiny_rotation_keeps_its_relative_accuracy():
    xi = np.array([1.0, 2.0, 3.0, 1e-150, -2e-150, 3e-150])
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, rtol=1e-13)


@pytest.mark.parametrize(
    "axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (0, -1, 1), (-1, 2, 3), (0, 0, -1)]
)
def test_at_a_half_turn_the_first_component_of_the_axis_is_positive(axis):
    unit = np.array(axis) / np.linalg.norm(axis)
    T = np.eye(4)
    T[:3, :3] = 2.0 * np.outer(unit, unit) - np.eye(3)
    first = next(component for component in axis if component)
    np.testing.assert_allclose(se3.log(T)[3:], unit * math.copysign(math.pi, first), atol=1e-13)


@pytest.mark.parametrize("angle", ANGLES + BEYOND_PI)
def test_left_jacobian_is_the_power_series_to_rounding(angle):
    for seed in range(3):
        xi = tangent(angle, seed)
        reference = oracle.left_jacobian(xi)
        assert oracle.worst(reference, se3.left_jacobian(xi)) <= 6 * EPS * oracle.largest(reference)


@pytest.mark.parametrize("angle", ANGLES + BEYOND_PI)
def test_inverse_left_jacobian_is_the_inverse_to_rounding(angle):
    for seed in range(3):
        xi = tangent(angle, seed)
        reference = oracle.inverse_left_jacobian(xi)
        # towards a full turn it grows without bound, and with it what the last digit of the angle means
        growth = max(1.0, 1.0 / (2.0 * math.pi - angle))
        assert oracle.worst(reference, se3.inverse_left_jacobian(xi)) <= 6 * EPS * growth * oracle.largest(
            reference
        )


def test_inverse_left_jacobian_is_the_polynomial_that_its_text_says():
    xi = tangent(1.3, 4)
    theta, ad, one = 1.3, plain.curly_hat(xi), np.eye(6)
    c = theta / 2 / math.tan(theta / 2)
    e = (1 - c) / theta**2
    d = (1 - c / 2 - theta**2 / (8 * math.sin(theta / 2) ** 2)) / theta**4
    squared = ad @ ad
    polynomial = one - ad / 2 + (e + theta**2 * d) * squared + d * squared @ squared
    np.testing.assert_allclose(se3.inverse_left_jacobian(xi), polynomial, atol=1e-13)


@pytest.mark.parametrize("order", [2, 4])
def test_series_of_the_inverse_jacobian_is_that_of_the_paper(order):
    xi = tangent(0.7, 5)
    ad = plain.curly_hat(xi)
    bernoulli = np.eye(6) - ad / 2 + ad @ ad / 12
    if order == 4:
        bernoulli = bernoulli - np.linalg.matrix_power(ad, 4) / 720
    np.testing.assert_allclose(plain.inverse_left_jacobian_series(xi, order), bernoulli, atol=1e-13)


@pytest.mark.parametrize("angle", [1e-9, 1e-3, 1.0, 3.0])
def test_left_jacobian_is_the_derivative_of_exp(angle):
    xi, direction = tangent(angle, 7), tangent(1.0, 8)
    h = oracle.mp.mpf(10) ** -25
    moved = oracle.exp([oracle.mp.mpf(x) + h * oracle.mp.mpf(d) for x, d in zip(xi, direction, strict=True)])
    difference = (moved * oracle.exp(xi) ** -1 - oracle.mp.eye(4)) / h
    expected = oracle.as_double(difference)
    np.testing.assert_allclose(plain.hat(se3.left_jacobian(xi) @ direction), expected, atol=1e-13)


@settings(max_examples=100, deadline=None)
@given(vectors(), vectors(), vectors())
def test_poses_are_a_group(a, b, c):
    A, B, C = se3.exp(a), se3.exp(b), se3.exp(c)
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-13)
    np.testing.assert_allclose(A @ se3.inverse(A), np.eye(4), atol=1e-13)
    np.testing.assert_allclose(se3.inverse(A), se3.exp(-a), atol=1e-13)
    np.testing.assert_allclose(A[:3, :3].T @ A[:3, :3], np.eye(3), atol=1e-13)


@settings(max_examples=200, deadline=None)
@given(vectors())
def test_log_undoes_exp(xi):
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-13)


@settings(max_examples=100, deadline=None)
@given(vectors(), vectors(), vectors())
def test_adjoint_maps_tangent_vectors_as_conjugation_does(a, b, xi):
    A, B = se3.exp(a), se3.exp(b)
    np.testing.assert_allclose(se3.adjoint(A @ B), se3.adjoint(A) @ se3.adjoint(B), atol=1e-13)
    np.testing.assert_allclose(se3.adjoint(se3.inverse(A)) @ se3.adjoint(A), np.eye(6), atol=1e-13)
    conjugated = A @ se3.exp(xi) @ se3.inverse(A)
    np.testing.assert_allclose(se3.exp(se3.adjoint(A) @ xi), conjugated, atol=1e-12)


@settings(max_examples=100, deadline=None)
@given(vectors(2 * math.pi - 0.1))
def test_jacobian_and_its_inverse_cancel(xi):
    product = se3.left_jacobian(xi) @ se3.inverse_left_jacobian(xi)
    np.testing.assert_allclose(product, np.eye(6), atol=1e-11)
    turned = se3.adjoint(se3.exp(xi)) @ se3.left_jacobian(-xi)
    np.testing.assert_allclose(se3.left_jacobian(xi), turned, atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(vectors())
def test_curly_hat_is_the_bracket_of_hats(xi):
    other = tangent(1.0, 3)
    bracket = plain.hat(xi) @ plain.hat(other) - plain.hat(other) @ plain.hat(xi)
    np.testing.assert_allclose(plain.hat(plain.curly_hat(xi) @ other), bracket, atol=1e-13)


def test_interpolation_goes_along_one_screw():
    T0, T1 = se3.exp(tangent(0.4, 1)), se3.exp(tangent(2.9, 2))
    np.testing.assert_array_equal(se3.interpolate(T0, T1, 0.0), T0)
    np.testing.assert_array_equal(se3.interpolate(T0, T1, 1.0), T1)
    middle = se3.interpolate(T0, T1, 0.5)
    np.testing.assert_allclose(middle @ se3.inverse(T0) @ middle, T1, atol=1e-13)
    np.testing.assert_allclose(se3.interpolate(T1, T0, 0.25), se3.interpolate(T0, T1, 0.75), atol=1e-13)


@settings(max_examples=200, deadline=None)
@given(vectors())
def test_rotations_agree_with_scipy(xi):
    rotation = Rotation.from_rotvec(xi[3:])
    R = se3.exp(xi)[:3, :3]
    np.testing.assert_allclose(R, rotation.as_matrix(), atol=1e-13)
    np.testing.assert_allclose(se3.quaternion_from_rotation(R), rotation.as_quat(canonical=True), atol=1e-13)
    np.testing.assert_allclose(se3.rotation_from_quaternion(rotation.as_quat()), R, atol=1e-13)


@settings(max_examples=200, deadline=None)
@given(st.tuples(st.floats(-3.1, 3.1), st.floats(-1.57, 1.57), st.floats(-3.1, 3.1)))
def test_euler_angles_are_sxyz_of_transforms3d_and_xyz_of_scipy(angles):
    pose = np.array([1.0, 2.0, 3.0, *angles])
    T = se3.pose_from_euler(pose)
    np.testing.assert_allclose(T[:3, :3], transforms3d.euler.euler2mat(*angles, "sxyz"), atol=1e-13)
    np.testing.assert_allclose(T[:3, :3], Rotation.from_euler("xyz", angles).as_matrix(), atol=1e-13)
    np.testing.assert_array_equal(T[:3, 3], pose[:3])
    np.testing.assert_allclose(se3.pose_from_euler(se3.euler_from_pose(T)), T, atol=1e-13)
    np.testing.assert_allclose(
        se3.euler_from_pose(T)[3:], transforms3d.euler.mat2euler(T[:3, :3]), atol=1e-13
    )


@pytest.mark.parametrize("beta", [math.pi / 2, -math.pi / 2])
def test_euler_angles_at_the_pole_have_gamma_zero_and_give_the_pose_back(beta):
    T = se3.pose_from_euler([0.0, 0.0, 0.0, 0.3, beta, 0.0])
    euler = se3.euler_from_pose(T)
    assert euler[5] == 0.0
    np.testing.assert_allclose(euler[3:], [0.3, beta, 0.0], atol=1e-13)


def test_orthonormalization_takes_rounding_out_and_refuses_more():
    T = se3.exp(tangent(1.0, 1))
    noisy = T.copy()
    noisy[:3, :3] += 1e-8 * np.random.default_rng(0).normal(size=(3, 3))
    R = se3.orthonormalized(noisy)[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-13)
    np.testing.assert_allclose(R, T[:3, :3], atol=1e-7)
    noisy[:3, :3] *= 1.001
    with pytest.raises(ValueError, match=r"not orthonormal, R\^T R is off the identity by 0.002"):
        se3.orthonormalized(noisy)
    with pytest.raises(ValueError, match="reflection"):
        se3.orthonormalized(np.diag([1.0, 1.0, -1.0, 1.0]))


@pytest.mark.parametrize(
    ("call", "argument", "message"),
    [
        (se3.exp, np.zeros(5), r"xi: must have shape \(6,\), has \(5,\)"),
        (se3.exp, [0, 0, 0, math.nan, 0, 0], "xi: must be finite"),
        (se3.log, np.eye(3), r"T: must have shape \(4, 4\), has \(3, 3\)"),
        (se3.log, np.full((4, 4), math.inf), "T: must be finite"),
        (se3.inverse, np.ones((4, 4)), r"last row must be \[0, 0, 0, 1\]"),
        (se3.left_jacobian, np.zeros((6, 1)), "xi: must have shape"),
        (se3.rotation_from_quaternion, np.zeros(4), "quaternion: is zero"),
        (se3.pose_from_euler, np.zeros(3), "pose6: must have shape"),
    ],
)
def test_bad_arguments_are_named(call, argument, message):
    with pytest.raises(ValueError, match=message):
        call(argument)


@pytest.mark.parametrize("angle", [1e-3, 0.5, 2.0, 3.1])
@pytest.mark.parametrize("off", [1e-12, 1e-9, 3e-7])
def test_log_of_a_matrix_that_is_a_little_off_is_that_of_the_nearest_rotation(angle, off):
    rng = np.random.default_rng(6)
    for _ in range(5):
        axis = rng.normal(size=3)
        T = se3.exp(np.concatenate((rng.normal(size=3), angle * axis / np.linalg.norm(axis))))
        T[:3, :3] += off * rng.uniform(-1.0, 1.0, (3, 3))
        exact = mp.matrix(T.tolist())
        R = exact[:3, :3]
        for _ in range(8):  # Newton's iteration for the orthogonal polar factor
            R = (R + (R**-1).T) / 2
        exact[:3, :3] = R
        expected = np.array([float(x) for x in oracle.closed_log(exact)])
        np.testing.assert_allclose(se3.log(T), expected, atol=4e-15)


@pytest.mark.parametrize("seed", range(4))
def test_products_carried_twists_and_points_are_those_of_the_matrices(seed):
    A, B = (se3.exp(tangent(angle, seed + 10 * k)) for k, angle in enumerate((0.7, 2.9)))
    xi, point = tangent(1.0, seed + 20), np.random.default_rng(seed).normal(size=3)
    np.testing.assert_allclose(se3.compose(A, B), A @ B, atol=1e-14)
    np.testing.assert_allclose(se3.between(A, B), np.linalg.inv(A) @ B, atol=1e-14)
    np.testing.assert_allclose(se3.carry(A, xi), se3.adjoint(A) @ xi, atol=1e-14)
    np.testing.assert_allclose(A @ [*se3.point_in(A, point), 1.0], [*point, 1.0], atol=1e-14)
