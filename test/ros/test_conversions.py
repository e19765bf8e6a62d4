"""Messages and arrays: exact there and back, and clear errors for what cannot be used."""

import array

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not in this environment: make, then . scripts/env.sh")

from geometry_msgs.msg import Quaternion, TwistStamped
from messages import arm_command, image_message
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image

from tactile_geometry import se3
from tactile_records.messages import bytes_from_array
from tactile_ros.conversions import array_from_image, matrix_from_pose, pose_from_matrix
from tactile_ros.message_bytes import (
    HeadedReader,
    command_from_bytes,
    image_from_bytes,
    read_gaussian,
    twist_bytes,
)
from tactile_wire.errors import MessageError
from tactile_wire.packing import gaussian_bytes
from tactile_wire.pose_numbers import gaussian_from_numbers, pose_from_numbers

RNG = np.random.default_rng(7)
ANGLES = [0.0, 1e-9, 1e-4, 1.0, 3.0, np.pi - 1e-9, np.pi]


def pose(angle: float, axis: np.ndarray) -> np.ndarray:
    return se3.exp(np.concatenate([RNG.normal(size=3), angle * axis / np.linalg.norm(axis)]))


@pytest.mark.parametrize("angle", ANGLES)
def test_poses_survive_the_way_through_a_message_at_every_angle(angle):
    for axis in [*np.eye(3), *-np.eye(3), *RNG.normal(size=(20, 3))]:
        T = pose(angle, axis)
        np.testing.assert_allclose(matrix_from_pose(pose_from_matrix(T)), T, atol=4e-15)


def test_quaternions_have_norm_one_and_a_real_part_that_is_not_negative():
    for axis in RNG.normal(size=(50, 3)):
        q = np.array(se3.quaternion_from_rotation(pose(RNG.uniform(0, np.pi), axis)[:3, :3]))
        assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-15) and q[3] >= 0.0


@pytest.mark.parametrize(
    "q", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.1), (np.nan, 0.0, 0.0, 1.0), (np.inf, 0.0, 0.0, 1.0)]
)
def test_a_quaternion_that_is_no_rotation_is_refused(q):
    with pytest.raises(MessageError, match="norm 1"):
        pose_from_numbers((0.0, 0.0, 0.0, *q))


def test_a_gaussian_survives_the_way_through_a_message():
    mean = pose(0.7, RNG.normal(size=3))
    root = RNG.normal(size=(6, 6))
    _, _, numbers = read_gaussian(gaussian_bytes(5, "s", mean, root @ root.T))
    got = gaussian_from_numbers(numbers)
    np.testing.assert_allclose(got.mean, mean, atol=1e-15)
    np.testing.assert_allclose(got.cov, root @ root.T, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("bad", ["nan pose", "nan covariance", "negative variance"])
def test_a_gaussian_that_is_none_is_refused(bad):
    numbers = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, *np.eye(6).ravel()]
    numbers[0 if bad == "nan pose" else 7] = -1.0 if bad == "negative variance" else np.nan
    with pytest.raises(MessageError, match=r"finite|negative"):
        gaussian_from_numbers(numbers)


def test_an_image_is_read_without_a_copy_and_rows_may_be_padded():
    data = array.array("B", bytes(range(12)))
    message = Image(height=3, width=2, step=4, encoding="mono8", data=data)
    image = array_from_image(message)
    assert image.tolist() == [[0, 1], [4, 5], [8, 9]]
    assert np.shares_memory(image, np.frombuffer(message.data, np.uint8))


def test_an_image_survives_the_way_through_a_message():
    image = RNG.integers(0, 256, (480, 640), dtype=np.uint8)
    assert np.array_equal(image_from_bytes(bytes_from_array(3, "s", image)).array(), image)
    part = image[10:20, 5:25]  # not contiguous
    assert np.array_equal(image_from_bytes(bytes_from_array(3, "s", part)).array(), part)


def test_an_image_in_color_survives_the_way_through_a_message_and_is_gray_where_that_is_wanted():
    image = RNG.integers(0, 256, (5, 7, 3), dtype=np.uint8)
    data = bytes_from_array(3, "s", image)
    message = deserialize_message(data, Image)
    assert (message.encoding, message.step, message.width, message.height) == ("bgr8", 21, 7, 5)
    received = image_from_bytes(data)
    assert np.array_equal(received.array(color=True), image)
    np.testing.assert_allclose(received.array(), image @ [0.114, 0.587, 0.299], atol=0.51)
    with pytest.raises(MessageError, match=r"must be uint8 \(height, width\) or"):
        bytes_from_array(3, "s", image[:, :, :2])


@pytest.mark.parametrize("frame_id", ["", "s", "sf", "arm", "arm/tactile_sensor", "größe"])
def test_the_bytes_of_an_image_are_those_of_the_message_class_at_every_alignment(frame_id):
    image = RNG.integers(0, 256, (5, 7), dtype=np.uint8)
    stamp_ns = 1_795_260_791_630_780_636
    ours = bytes_from_array(stamp_ns, frame_id, image)
    assert deserialize_message(ours, Image) == image_message(stamp_ns, frame_id, image)
    received = image_from_bytes(serialize_message(image_message(stamp_ns, frame_id, image)))
    assert received.stamp_ns == stamp_ns
    assert np.array_equal(received.array(), image)


@pytest.mark.parametrize("encoding", ["bayer_rggb8", "mono16", "", "32FC1"])
def test_the_fields_of_a_serialized_image_are_checked_like_those_of_a_message(encoding):
    message = Image(height=2, width=3, step=4, encoding=encoding, data=bytes(range(8)))
    with pytest.raises(MessageError, match="must be 'mono8'"):
        image_from_bytes(serialize_message(message)).array()
    message.encoding = "mono8"
    assert image_from_bytes(serialize_message(message)).array().tolist() == [[0, 1, 2], [4, 5, 6]]


def test_a_twist_survives_the_way_through_a_message():
    twist = RNG.normal(size=6)
    assert HeadedReader(TwistStamped)(twist_bytes(1, "s", twist)) == (1, "s", tuple(twist))


def test_a_command_is_read_with_who_sent_it():
    twist = RNG.normal(size=6)
    message = arm_command(7, "s", twist, "/me")
    message.session, message.sequence = 2**64 - 1, 5
    found = command_from_bytes(serialize_message(message))
    assert (found.stamp_ns, found.frame_id, found.source) == (7, "s", "/me")
    assert (found.session, found.sequence, found.twist.tolist()) == (2**64 - 1, 5, twist.tolist())


def test_the_identity_quaternion_is_the_default_of_messages():
    q = Quaternion()
    assert np.array_equal(pose_from_numbers((0.0, 0.0, 0.0, q.x, q.y, q.z, q.w)), np.eye(4))
