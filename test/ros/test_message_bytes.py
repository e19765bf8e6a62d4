"""Messages packed and read as bytes are those that rclpy's own classes make and read."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not in this environment: make, then . scripts/env.sh")

from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from hypothesis import given
from hypothesis import strategies as st
from messages import arm_command, gaussian_message, twist_stamped
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import Image
from tf2_msgs.msg import TFMessage

from tactile_geometry import se3
from tactile_msgs.msg import ArmStatus, ContactPresence, ContactState, ContactTruth, ControllerStatus
from tactile_records.messages import bytes_from_array
from tactile_ros.conversions import (
    transform_stamped,
)
from tactile_ros.message_bytes import (
    HeadedReader,
    Layout,
    command_from_bytes,
    headed_bytes,
    image_from_bytes,
    transforms_from_bytes,
    twist_bytes,
)
from tactile_wire.errors import MessageError
from tactile_wire.packing import LONGEST_SAID, gaussian_bytes

STORE = get_typestore(Stores.LATEST)
HEADED = [PoseWithCovarianceStamped, TwistStamped, ContactPresence, ContactState, ContactTruth]
STRINGS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20)


def numbers_of(message):
    """All numbers of a message, nested ones included, in the order of its definition, by its Python class."""
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        for each in value if "[" in kind or kind.startswith("sequence<") else [value]:
            if hasattr(each, "get_fields_and_field_types"):
                yield from numbers_of(each)
            elif not isinstance(each, str):
                yield each


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


def test_big_endian_bytes_are_read():
    types, vector = STORE.types, STORE.types["geometry_msgs/msg/Vector3"]
    head = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](7, 8), "sensor")
    twist = types["geometry_msgs/msg/Twist"](vector(1.0, 2.0, 3.0), vector(4.0, 5.0, 6.0))
    message = types["geometry_msgs/msg/TwistStamped"](head, twist)
    data = bytes(STORE.serialize_cdr(message, "geometry_msgs/msg/TwistStamped", little_endian=False))
    assert HeadedReader(TwistStamped)(data) == (7_000_000_008, "sensor", (1.0, 2.0, 3.0, 4.0, 5.0, 6.0))


def test_bytes_that_are_no_message_are_an_error_that_says_why():
    data = serialize_message(filled(TwistStamped, 3)[0])
    with pytest.raises(MessageError, match="TwistStamped: cut, has 40 bytes"):
        HeadedReader(TwistStamped)(data[:40])
    with pytest.raises(MessageError, match="encapsulation 0xffff is no plain CDR"):
        HeadedReader(TwistStamped)(b"\xff\xff" + data[2:])
    with pytest.raises(MessageError, match="TFMessage"):
        transforms_from_bytes(serialize_message(TFMessage())[:6])


def test_long_texts_are_cut_where_they_are_sent_and_refused_where_they_come():
    numbers = (0, -1.0, False, *[0.0] * 6)
    status = deserialize_message(headed_bytes(ArmStatus, 1, "base", *numbers, reason="x" * 10**7), ArmStatus)
    assert status.reason == "x" * LONGEST_SAID
    stranger = arm_command(1, "sensor", np.zeros(6), source="s" * 10**5)
    with pytest.raises(MessageError, match=r"source has 100000 characters, at most \d+ may be"):
        command_from_bytes(serialize_message(stranger))
    stranger.source = "s" * 2 * 10**6
    with pytest.raises(MessageError, match="source has 2000001 bytes, must have no more than"):
        command_from_bytes(serialize_message(stranger))


def test_numbers_are_found_by_the_name_of_their_field():
    reader, message = HeadedReader(ContactState), filled(ContactState, 4)[0]
    _, _, numbers = reader(serialize_message(message))
    assert numbers[reader.place("flags")] == (message.flags,)
    for name in ("xi", "covariance", "euler"):
        assert list(numbers[reader.place(name)]) == list(getattr(message, name))
    assert numbers[reader.place("latency")] == (message.latency.sec, message.latency.nanosec)
    with pytest.raises(KeyError, match="flag; fields: header"):
        reader.place("flag")


@pytest.mark.parametrize("shape", [(3, 5), (480, 640), (0, 4), (3, 5, 3)])
def test_the_bytes_of_an_image_are_those_of_its_message(shape):
    pixels = np.random.default_rng(5).integers(0, 255, shape, dtype=np.uint8)
    data = bytes_from_array(9, "sensor", pixels)
    message = deserialize_message(data, Image)
    encoding, step = ("bgr8", 3 * shape[1]) if len(shape) == 3 else ("mono8", shape[1])
    assert (message.height, message.width, message.step) == (*shape[:2], step)
    assert (message.encoding, message.header.frame_id) == (encoding, "sensor")
    assert message.data.tobytes() == pixels.tobytes()
    for received in map(image_from_bytes, (data, serialize_message(message))):
        assert (received.stamp_ns, received.height, received.width) == (9, *shape[:2])
        assert received.pixels.tobytes() == pixels.tobytes()


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
    data = headed_bytes(ContactPresence, -5, "s", 0.1, 0.2, True, False, 0.5)
    message = deserialize_message(data, ContactPresence)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (0, 0)
