"""What nodes send and take at the rate of the camera, as bytes: see `cdr` for why.

The numbers of a message are given in the order of its definition, behind stamp and frame.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from numpy.typing import ArrayLike, NDArray

from tactile_filter.gaussian import ros_from_left
from tactile_ros.cdr import HeadedReader, Layout, Number, split_stamp
from tactile_ros.conversions import numbers_from_pose

Array = NDArray[np.float64]


def headed_bytes(message_type: Any, stamp_ns: int, frame_id: str, *numbers: Number) -> bytes:
    """A message whose only string is its header's frame."""
    return _headed_layout(message_type, frame_id).pack(*split_stamp(stamp_ns), *numbers)


def twist_bytes(stamp_ns: int, frame_id: str, twist: ArrayLike) -> bytes:
    """TwistStamped of [v, omega] (6,) in `frame_id`."""
    return headed_bytes(TwistStamped, stamp_ns, frame_id, *np.asarray(twist, dtype=np.float64).tolist())


def gaussian_bytes(stamp_ns: int, frame_id: str, mean: Array, cov: Array) -> bytes:
    """PoseWithCovarianceStamped of a mean (4, 4) with left covariance (6, 6), both in `frame_id`."""
    ros = ros_from_left(cov, mean[:3, 3])
    numbers = (*numbers_from_pose(mean).tolist(), *ros.ravel().tolist())
    return headed_bytes(PoseWithCovarianceStamped, stamp_ns, frame_id, *numbers)


read_gaussian = HeadedReader(PoseWithCovarianceStamped)
"""Stamp (ns), frame and numbers; `conversions.gaussian_from_numbers` checks these and makes a Gaussian."""

read_twist = HeadedReader(TwistStamped)
"""Stamp (ns), frame and [v, omega] (6 numbers, which may be NaN: that is for the limiter to refuse)."""


@functools.lru_cache(maxsize=64)
def _headed_layout(message_type: Any, frame_id: str) -> Layout:
    example = message_type()
    example.header.frame_id = frame_id
    return Layout(example)
