"""Left covariance <-> covariance of a ROS pose: Monte Carlo decides the sign."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian, left_from_ros, ros_from_left


def covariance(seed):
    factor = np.random.default_rng(seed).normal(size=(6, 6))
    return factor @ factor.T


def sampled_ros_covariance(mean, cov, count=100_000):
    """Of position errors and fixed-axis rotation errors of poses drawn with a left perturbation."""
    eps = np.random.default_rng(5).multivariate_normal(np.zeros(6), cov, size=count)
    turn = Rotation.from_rotvec(eps[:, 3:])
    # exp(eps^) mean moves the position to V rho + R p; V is 1 to the order that counts here
    moved = eps[:, :3] + turn.apply(mean[:3, 3]) - mean[:3, 3]
    turned = turn * Rotation.from_matrix(mean[:3, :3])
    rotation = (turned * Rotation.from_matrix(mean[:3, :3]).inv()).as_rotvec()
    return np.cov(np.column_stack((moved, rotation)).T)


def test_covariance_of_a_ros_pose_is_what_samples_show():
    mean = se3.exp([0.4, -0.3, 0.2, 0.3, 0.8, -0.5])
    cov = 1e-6 * covariance(1)
    expected = sampled_ros_covariance(mean, cov)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    converted = ros_from_left(cov, mean[:3, 3])
    assert np.abs((converted - expected) / scale).max() < 0.015
    # with the other sign, the samples refute it
    wrong = ros_from_left(cov, -mean[:3, 3])
    assert np.abs((wrong - expected) / scale).max() > 0.2


def test_the_two_directions_undo_each_other():
    cov, position = covariance(2), np.array([10.0, -3.0, 0.5])
    np.testing.assert_allclose(left_from_ros(ros_from_left(cov, position), position), cov, atol=1e-11)


def test_at_the_origin_the_two_are_the_same():
    np.testing.assert_array_equal(ros_from_left(np.eye(6), np.zeros(3)), np.eye(6))


def test_a_pure_rotation_error_moves_a_position_on_the_x_axis_along_y_and_z():
    left = np.diag([0.0, 0.0, 0.0, 0.0, 1e-4, 4e-4])
    ros = ros_from_left(left, [2.0, 0.0, 0.0])
    np.testing.assert_allclose(np.diag(ros)[:3], [0.0, 4 * 4e-4, 4 * 1e-4])
    # a turn about +z moves it along +y, one about +y along -z
    assert ros[1, 5] > 0.0
    assert ros[2, 4] < 0.0


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match=r"cov must have shape \(\.\.\., 6, 6\)"):
        ros_from_left(np.eye(5), np.zeros(3))
    with pytest.raises(ValueError, match=r"mean: must have shape \(4, 4\), has \(3, 3\)"):
        PoseGaussian(np.eye(3), np.eye(6))
    with pytest.raises(ValueError, match=r"cov: must have shape \(6, 6\), has \(6,\)"):
        PoseGaussian(np.eye(4), np.ones(6))
