"""Messages packed and read as bytes are those that rclpy's own classes make and read."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not in this environment: make, then . scripts/env.sh")

from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from hypothesis import given
from hypothesis import strategies as st
from messages import gaussian_message, twist_stamped
from rclpy.serialization import deserialize_message, serialize_message
from tf2_msgs.msg import TFMessage

from tactile_filter import se3
from tactile_msgs.msg import ArmStatus, ContactPresence, ContactState, ContactTruth, ControllerStatus
from tactile_ros import cdr
from tactile_ros.cdr import HeadedReader, Layout, numbers_of, transforms_from_bytes
from tactile_ros.conversions import (
    transform_stamped,
)
from tactile_ros.wire import gaussian_bytes, headed_bytes, twist_bytes

HEADED = [PoseWithCovarianceStamped, TwistStamped, ContactPresence, ContactState, ContactTruth]
STRINGS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20)


def filled(message_type, seed: int, **strings):
    """A message with numbers of its own in every field."""
    example = message_type(**strings)
    random = np.random.default_rng(seed)
    numbers = [
        bool(random.integers(2)) if isinstance(n, bool) else type(n)(random.integers(1, 200))
        for n in numbers_of(example)
    ]
    return deserialize_message(Layout(example).pack(*numbers), message_type), numbers


@pytest.mark.parametrize("message_type", [*HEADED, ControllerStatus, ArmStatus])
def test_every_number_arrives_where_the_definition_has_it(message_type):
    message, numbers = filled(message_type, 1)
    assert list(numbers_of(message)) == numbers


@given(frame=STRINGS, phase=STRINGS, reason=STRINGS)
def test_strings_of_any_length_shift_what_follows_as_rclpy_does(frame, phase, reason):
    message = ControllerStatus(phase=phase, reason=reason, progress=0.5, belief_age=-1.0)
    message.header.frame_id = frame
    packed = Layout(message).pack(*numbers_of(message))
    assert deserialize_message(packed, ControllerStatus) == message
    assert Layout(message).unpack(serialize_message(message)) == tuple(numbers_of(message))


@pytest.mark.parametrize("message_type", HEADED)
@given(frame=STRINGS)
def test_what_rclpy_writes_is_read(message_type, frame):
    message, numbers = filled(message_type, 2)
    message.header.frame_id = frame
    stamp_ns, got_frame, got = HeadedReader(message_type)(serialize_message(message))
    assert stamp_ns == numbers[0] * 1_000_000_000 + numbers[1]
    assert got_frame == frame and list(got) == numbers[2:]


def test_bytes_that_are_not_plain_little_endian_go_through_the_message_class(monkeypatch):
    message, numbers = filled(TwistStamped, 3)
    data = serialize_message(message)
    transforms = serialize_message(TFMessage(transforms=[transform_stamped(7, "a", "b", np.eye(4))]))
    plain = HeadedReader(TwistStamped)(data), transforms_from_bytes(transforms)
    monkeypatch.setattr(cdr, "PLAIN_CDR_LE", b"\xff\xff")
    assert (HeadedReader(TwistStamped)(data), transforms_from_bytes(transforms)) == plain
    assert list(plain[0][2]) == numbers[2:]


@given(names=st.lists(st.tuples(STRINGS, STRINGS), max_size=4))
def test_transforms_are_read_whatever_their_names(names):
    T = se3.exp(np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.6]))
    message = TFMessage(transforms=[transform_stamped(n + 5, a, b, T) for n, (a, b) in enumerate(names)])
    for data in (serialize_message(message), Layout(message).pack(*numbers_of(message))):
        read = transforms_from_bytes(data)
        assert [(t.stamp_ns, t.parent, t.child) for t in read] == [
            (n + 5, a, b) for n, (a, b) in enumerate(names)
        ]
        for t in read:
            np.testing.assert_allclose(t.translation, T[:3, 3], atol=0)
            np.testing.assert_allclose(se3.rotation_from_quaternion(t.rotation), T[:3, :3], atol=1e-15)


def test_a_number_too_few_or_too_many_is_an_error():
    layout = Layout(TwistStamped())
    with pytest.raises(ValueError, match="8 numbers, 7 were given"):
        layout.pack(*range(7))


def test_the_bytes_of_gaussians_and_twists_are_those_of_their_messages():
    mean = se3.exp(np.array([0.001, 0.002, -0.003, 0.1, -0.2, 0.05]))
    root = np.random.default_rng(4).normal(size=(6, 6))
    packed = deserialize_message(gaussian_bytes(9, "s", mean, root @ root.T), PoseWithCovarianceStamped)
    assert packed == gaussian_message(9, "s", mean, root @ root.T)
    twist = [1.0, 2.0, 3.0, np.inf, 5.0, 6.0]
    assert deserialize_message(twist_bytes(9, "s", twist), TwistStamped) == twist_stamped(9, "s", twist)


def test_a_stamp_before_the_epoch_is_none():
    message = deserialize_message(headed_bytes(ContactPresence, -5, "s", 0.1, 0.2, True), ContactPresence)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (0, 0)
