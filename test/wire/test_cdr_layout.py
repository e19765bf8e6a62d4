"""Layouts of messages agree with what `rosbags` serializes, and name their fields."""

import numpy as np
import pytest
from replay_bags import ESTIMATE, PRESENCE, START_NS, TRANSFORMS, header, make, pose, serialized, transform

from tactile_geometry import se3
from tactile_wire.cdr import MessageReader, blank_layout

T = se3.exp(np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.6]))
SEC, NANOSEC = divmod(START_NS, 10**9)


@pytest.mark.parametrize("frame", ["", "a", "arm/tactile_sensor", "größer"])
def test_packed_bytes_are_those_of_the_message(frame):
    covariance = np.arange(36.0)
    content = make("geometry_msgs/msg/PoseWithCovariance", pose(T), covariance)
    message = serialized(make(ESTIMATE, header(START_NS, frame), content), ESTIMATE)
    layout = blank_layout(ESTIMATE, {"header.frame_id": frame})
    numbers = SEC, NANOSEC, *T[:3, 3], *se3.quaternion_from_rotation(T[:3, :3]), *covariance
    assert layout.pack(*numbers) == message and layout.unpack(message) == numbers


def test_sequences_are_packed_by_their_lengths_and_their_parts_found_by_name():
    names = {f"transforms.{k}.child_frame_id": f"child{k}" for k in range(3)}
    names |= {f"transforms.{k}.header.frame_id": "parent" for k in range(3)}
    layout = blank_layout(TRANSFORMS, names, {"transforms": 3})
    message = make(TRANSFORMS, [transform(START_NS, "parent", f"child{k}", T) for k in range(3)])
    data = serialized(message, TRANSFORMS)
    assert layout.matches(data) and layout.pack(*layout.unpack(data)) == data
    assert layout.unpack(data)[layout.place("transforms.1.transform.translation")] == tuple(T[:3, 3])
    assert layout.unpack(data)[layout.place("transforms.2.header.stamp")] == (SEC, NANOSEC)


def test_a_reader_follows_strings_that_change_from_message_to_message():
    read = MessageReader(PRESENCE)
    for k in range(200):
        frame = "x" * (k % 90)
        message = make(PRESENCE, header(k, frame), 0.5, 0.25, True, False, 0.75)
        layout, numbers = read(serialized(message, PRESENCE))
        assert layout.texts == {"header.frame_id": frame} and numbers == (0, k, 0.5, 0.25, True, False, 0.75)


def test_what_stands_before_the_elements_of_a_sequence_is_read_without_them():
    image = "sensor_msgs/msg/Image"
    pixels = np.arange(12, dtype=np.uint8)
    data = serialized(make(image, header(7, "s"), 3, 4, "mono8", 0, 4, pixels), image)
    layout, numbers = MessageReader(image, before="data")(data)
    assert numbers == (0, 7, 3, 4, 0, 4) and layout.lengths == {"data": 12}
    assert data[len(layout.template) :][:12] == pixels.tobytes()
