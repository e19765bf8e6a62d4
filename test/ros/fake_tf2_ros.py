"""What `Tf2Store` uses of tf2_ros, for where that is not installed.

It behaves like tf2 0.39 where that differs from our own buffer: a time of zero asks for the newest, one
exception stands for too early and too late, an infinite translation is taken, what cannot be used is dropped
without an error, a leading slash is no part of a name, and the newest stamp of a chain that does not move is
zero. Where tf2_ros is installed, the same tests run on it instead.
"""

import logging

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.time import Time

from tactile_filter.transform_buffer import TransformBuffer, TransformDisconnected, TransformUnavailable
from tactile_ros.conversions import matrix_from_transform, transform_stamped
from tactile_ros.stamps import ns_from_time


class TransformException(Exception):
    """Base of the others."""


class ConnectivityException(TransformException):
    """No chain between the frames."""


class ExtrapolationException(TransformException):
    """Too early or too late."""


class Buffer:
    """The methods of `tf2_ros.Buffer` with their signatures, on top of our own buffer."""

    def __init__(self) -> None:
        self._tree = TransformBuffer()

    def set_transform(self, transform: TransformStamped, authority: str) -> None:
        self._set(transform, static=False)

    def set_transform_static(self, transform: TransformStamped, authority: str) -> None:
        self._set(transform, static=True)

    def lookup_transform(self, target_frame: str, source_frame: str, time: Time) -> TransformStamped:
        stamp_ns = time.nanoseconds or self.get_latest_common_time(target_frame, source_frame).nanoseconds
        try:
            T = self._tree.lookup(target_frame, source_frame, stamp_ns)
        except TransformDisconnected as error:
            raise ConnectivityException(str(error)) from error
        except TransformUnavailable as error:
            raise ExtrapolationException("would require extrapolation") from error
        return transform_stamped(stamp_ns, target_frame, source_frame, T)

    def get_latest_common_time(self, target_frame: str, source_frame: str) -> Time:
        try:
            return Time(nanoseconds=self._tree.latest_stamp(target_frame, source_frame) or 0)
        except TransformUnavailable as error:
            raise TransformException(str(error)) from error

    def clear(self) -> None:
        self._tree.clear()

    def _set(self, transform: TransformStamped, static: bool) -> None:
        names = (name.removeprefix("/") for name in (transform.header.frame_id, transform.child_frame_id))
        try:
            T = np.nan_to_num(matrix_from_transform(transform.transform), posinf=1e300)
            self._tree.set_transform(*names, ns_from_time(transform.header.stamp), T, static=static)
        except ValueError as error:
            logging.getLogger("tf2").error("ignoring a transform: %s", error)  # as tf2 does
