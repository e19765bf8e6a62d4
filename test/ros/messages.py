"""Messages by their classes: what nodes send and take as bytes is fed and compared with these."""

import array

import numpy as np
from geometry_msgs.msg import (
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    Transform,
    Twist,
    TwistStamped,
    Vector3,
)
from sensor_msgs.msg import Image

from tactile_geometry.gaussian import PoseGaussian, ros_from_left
from tactile_msgs.msg import ArmCommand
from tactile_perception.estimating.encodings import MONO8
from tactile_ros.conversions import header, pose_from_matrix
from tactile_wire.pose_numbers import gaussian_from_numbers, pose_from_numbers


def matrix_from_transform(transform: Transform) -> np.ndarray:
    """T_parent_child (4, 4)."""
    p, q = transform.translation, transform.rotation
    return pose_from_numbers((p.x, p.y, p.z, q.x, q.y, q.z, q.w))


def vector_from_twist(twist: Twist) -> np.ndarray:
    """[v, omega] (6,)."""
    v, omega = twist.linear, twist.angular
    return np.array((v.x, v.y, v.z, omega.x, omega.y, omega.z))


def twist_stamped(stamp_ns: int, frame_id: str, twist) -> TwistStamped:
    """Of [v, omega] (6,)."""
    vx, vy, vz, wx, wy, wz = np.asarray(twist, dtype=np.float64).tolist()
    message = Twist(linear=Vector3(x=vx, y=vy, z=vz), angular=Vector3(x=wx, y=wy, z=wz))
    return TwistStamped(header=header(stamp_ns, frame_id), twist=message)


def arm_command(stamp_ns: int, frame_id: str, twist, source: str = "/test") -> ArmCommand:
    """Of [v, omega] (6,)."""
    numbers = np.asarray(twist, dtype=np.float64)
    return ArmCommand(header=header(stamp_ns, frame_id), source=source, twist=numbers)


def gaussian_from_message(message: PoseWithCovariance) -> PoseGaussian:
    """With left covariance."""
    p, q = message.pose.position, message.pose.orientation
    return gaussian_from_numbers((p.x, p.y, p.z, q.x, q.y, q.z, q.w, *message.covariance))


def gaussian_message(stamp_ns: int, frame_id: str, mean: np.ndarray, cov: np.ndarray):
    """Of a mean (4, 4) with left covariance (6, 6)."""
    ros = ros_from_left(cov, mean[:3, 3])
    pose = PoseWithCovariance(pose=pose_from_matrix(mean), covariance=np.ascontiguousarray(ros).reshape(36))
    return PoseWithCovarianceStamped(header=header(stamp_ns, frame_id), pose=pose)


def image_message(stamp_ns: int, frame_id: str, image: np.ndarray) -> Image:
    """Of an image uint8, gray (height, width) or in color (height, width, 3)."""
    data = array.array("B", image.tobytes())
    height, width, *colors = image.shape
    step, encoding = (3 * width, "bgr8") if colors else (width, MONO8)
    return Image(
        header=header(stamp_ns, frame_id), height=height, width=width, encoding=encoding, step=step, data=data
    )
