"""Messages <-> Python: stamps (int nanoseconds), poses, transforms, images.

What is sent at the rate of the camera is in `message_bytes`.

Poses are `T_parent_child` (4, 4) in meters. Whatever comes in is checked; `MessageError` says what was wrong
and what would be right.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, TransformStamped, Vector3
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from tactile_base.stamps import ns_from_parts, parts_from_ns
from tactile_perception.estimating.encodings import pixels_of
from tactile_perception.estimating.image import ImageError
from tactile_wire.errors import MessageError
from tactile_wire.pose_numbers import numbers_from_pose, pose_from_numbers

Array = NDArray[np.float64]


def message_class(name: str) -> Any:
    """The class of a type `package/msg/Name`, or of what an action publishes; None: not installed."""
    package, kind, message = name.split("/")
    action, _, part = message.rpartition("_")
    try:
        module = importlib.import_module(f"{package}.{kind}")
        return getattr(module, message) if kind == "msg" else getattr(getattr(module, action).Impl, part)
    except (ImportError, AttributeError):
        return None


def ns_from_time(stamp: Time | Duration) -> int:
    """Nanoseconds of a Time or Duration message."""
    return ns_from_parts(stamp.sec, stamp.nanosec)


def time_from_ns(stamp_ns: int) -> Time:
    """Time message of nanoseconds since the epoch; negative ones become zero, which ROS reads as 'none'."""
    sec, nanosec = parts_from_ns(max(int(stamp_ns), 0))
    return Time(sec=sec, nanosec=nanosec)


def duration_from_ns(duration_ns: int) -> Duration:
    """Duration message of nanoseconds."""
    sec, nanosec = parts_from_ns(duration_ns)
    return Duration(sec=sec, nanosec=nanosec)


def header(stamp_ns: int, frame_id: str) -> Header:
    """Header with this stamp and frame."""
    return Header(stamp=time_from_ns(stamp_ns), frame_id=frame_id)


def matrix_from_pose(pose: Pose) -> Array:
    """T (4, 4) of a Pose message."""
    p, q = pose.position, pose.orientation
    return pose_from_numbers((p.x, p.y, p.z, q.x, q.y, q.z, q.w))


def pose_from_matrix(T: Array) -> Pose:
    """Pose message of T (4, 4)."""
    x, y, z, *q = numbers_from_pose(T).tolist()
    return Pose(position=Point(x=x, y=y, z=z), orientation=_quaternion(q))


def transform_stamped(stamp_ns: int, parent: str, child: str, T_parent_child: Array) -> TransformStamped:
    """TransformStamped message of T_parent_child (4, 4)."""
    x, y, z, *q = numbers_from_pose(T_parent_child).tolist()
    transform = Transform(translation=Vector3(x=x, y=y, z=z), rotation=_quaternion(q))
    return TransformStamped(header=header(stamp_ns, parent), child_frame_id=child, transform=transform)


def array_from_image(message: Image, color: bool = False) -> NDArray[np.uint8]:
    """Gray image (height, width) uint8, or with `color` (height, width, 3) of one that has colors.

    It may share the message's memory, see `encodings.pixels_of`.

    Raises
    ------
    MessageError
        If the encoding is not known, or width, height, step and the number of bytes contradict each other.
    """
    pixels = np.frombuffer(message.data, dtype=np.uint8)
    numbers = int(message.height), int(message.width), int(message.step)
    return checked_image(pixels, *numbers, message.encoding, color)


def checked_image(
    pixels: NDArray[np.uint8], height: int, width: int, step: int, encoding: str, color: bool = False
) -> NDArray[np.uint8]:
    """The pixels of a message as `array_from_image` gives them; raises `MessageError` as that does."""
    try:
        return pixels_of(pixels, height, width, step, encoding, color)
    except ImageError as error:
        raise MessageError(str(error)) from error


def _quaternion(q: Sequence[float]) -> Quaternion:
    x, y, z, w = q
    return Quaternion(x=x, y=y, z=z, w=w)
