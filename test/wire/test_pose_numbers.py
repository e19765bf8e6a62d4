"""The numbers of messages as poses and Gaussians: checked, and of many the bits of each."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_geometry import se3
from tactile_geometry.gaussian import UNUSABLE, left_from_ros, ros_from_left
from tactile_wire.errors import MessageError
from tactile_wire.pose_numbers import (
    are_poses,
    gaussian_from_numbers,
    gaussians_from_numbers,
    numbers_from_pose,
    pose_from_numbers,
)

ORIGIN = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]


def poses(count):
    """Positions and quaternions whose norm is a little off 1."""
    random = np.random.default_rng(3)
    numbers = random.standard_normal((count, 7))
    numbers[:, 3:] /= np.linalg.norm(numbers[:, 3:], axis=1)[:, None]
    numbers[:, 3:] *= 1.0 + 5e-4 * random.uniform(-1, 1, (count, 1))
    return numbers


def covariances(count):
    random = np.random.default_rng(4)
    factors = random.standard_normal((count, 6, 6)) * 10.0 ** random.uniform(-6, 2, (count, 1, 6))
    return factors @ factors.transpose(0, 2, 1)


def test_poses_are_those_of_scipy():
    numbers = poses(50)
    T = pose_from_numbers(numbers)
    np.testing.assert_allclose(T[:, :3, :3], Rotation.from_quat(numbers[:, 3:]).as_matrix(), atol=4e-15)
    np.testing.assert_array_equal(T[:, :3, 3], numbers[:, :3])
    np.testing.assert_array_equal(T[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (50, 1)))
    expected = Rotation.from_matrix(T[:, :3, :3]).as_quat(canonical=True)
    np.testing.assert_allclose(numbers_from_pose(T)[:, 3:], expected, atol=4e-15)


def test_many_poses_and_covariances_have_the_bits_of_each():
    numbers, covs = poses(300), covariances(300)
    T, back = pose_from_numbers(numbers), numbers_from_pose(pose_from_numbers(numbers))
    left, ros = left_from_ros(covs, numbers[:, :3]), ros_from_left(covs, numbers[:, :3])
    for k in range(300):
        np.testing.assert_array_equal(T[k], pose_from_numbers(numbers[k]))
        np.testing.assert_array_equal(back[k], numbers_from_pose(T[k]))
        np.testing.assert_array_equal(left[k], left_from_ros(covs[k], numbers[k, :3]))
        np.testing.assert_array_equal(ros[k], ros_from_left(covs[k], numbers[k, :3]))


def test_many_gaussians_have_the_bits_of_each_and_those_that_are_refused_are_unusable():
    numbers = np.concatenate([poses(20), covariances(20).reshape(20, 36)], axis=1)
    numbers[3, 0] = numbers[7, 20] = np.nan
    numbers[11, 6] += 1.0
    numbers[15, 7] = -1e-9
    refused = {3, 7, 11, 15}
    for k, gaussian in enumerate(gaussians_from_numbers(numbers)):
        if k in refused:
            assert gaussian is UNUSABLE
            with pytest.raises(MessageError):
                gaussian_from_numbers(numbers[k].tolist())
        else:
            expected = gaussian_from_numbers(numbers[k].tolist())
            np.testing.assert_array_equal(gaussian.mean, expected.mean)
            np.testing.assert_array_equal(gaussian.cov, expected.cov)


def test_none_of_no_poses_are_answered_with_none():
    assert pose_from_numbers(np.zeros((0, 7))).shape == (0, 4, 4)
    assert gaussians_from_numbers(np.zeros((0, 43))) == []


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ([np.nan, *ORIGIN[1:]], r"position \(nan, 0.0, 0.0\) is not finite"),
        ([*ORIGIN[:6], 0.9], r"quaternion .* \(0.0, 0.0, 0.0, 0.9\): must have norm 1"),
        ([*ORIGIN[:6], np.inf], "must have norm 1"),
        ([0.0] * 7, "must have norm 1"),
    ],
)
def test_numbers_that_are_no_pose_are_refused_with_what_they_are(numbers, message):
    assert are_poses([ORIGIN, numbers]).tolist() == [True, False]
    with pytest.raises(MessageError, match=message):
        pose_from_numbers([ORIGIN, numbers])


def test_a_covariance_that_is_none_is_refused_with_its_diagonal():
    with pytest.raises(MessageError, match=r"has a negative variance; its diagonal is \[1.0, 1.0, -1\.0"):
        gaussian_from_numbers([*ORIGIN, *np.diag([1.0, 1.0, -1.0, 1.0, 1.0, 1.0]).ravel()])


def test_euler_angles_of_many_are_those_of_each():
    T = pose_from_numbers(poses(40)).reshape(5, 8, 4, 4)
    euler = se3.euler_from_pose(T)
    assert euler.shape == (5, 8, 6)
    back = se3.pose_from_euler(euler)
    for k in np.ndindex(5, 8):
        np.testing.assert_array_equal(euler[k], se3.euler_from_pose(T[k]))
        np.testing.assert_array_equal(back[k], se3.pose_from_euler(euler[k]))
