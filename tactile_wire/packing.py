"""Messages with a header as the bytes that travel, packed without their Python classes and without ROS.

Those classes cost 0.1 to 0.3 ms a message, and more on a core that has just woken up; a `Layout` packs all
numbers of a message at once, in the places that its definition gives them (`tactile_wire.cdr`).
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_geometry.gaussian import ros_from_left
from tactile_wire.cdr import Layout, Number, blank_layout
from tactile_wire.pose_numbers import numbers_from_pose

Array = NDArray[np.float64]

FRAME = "header.frame_id"
LONGEST_SAID = 1000  # characters of a text that nodes send
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"


def headed_bytes(type_name: str, stamp_ns: int, frame_id: str, *numbers: Number, **texts: str) -> bytes:
    """A message with a header: its numbers in the order of the definition, its texts by name.

    Long ones are cut: they are sent many times a second, and kept for whoever has missed them.
    """
    if any(len(text) > LONGEST_SAID for text in texts.values()):
        texts = {name: text[:LONGEST_SAID] for name, text in texts.items()}
    return _headed_layout(type_name, frame_id, **texts).pack(*split_stamp(stamp_ns), *numbers)


@functools.lru_cache(maxsize=64)
def _headed_layout(type_name: str, frame_id: str, **texts: str) -> Layout:
    return blank_layout(type_name, {FRAME: frame_id, **texts})


def gaussian_bytes(stamp_ns: int, frame_id: str, mean: Array, cov: Array) -> bytes:
    """PoseWithCovarianceStamped of a mean (4, 4) with left covariance (6, 6), both in `frame_id`."""
    ros = ros_from_left(cov, mean[:3, 3])
    numbers = (*numbers_from_pose(mean).tolist(), *ros.ravel().tolist())
    return headed_bytes(POSE_WITH_COVARIANCE, stamp_ns, frame_id, *numbers)


def split_stamp(stamp_ns: int) -> tuple[int, int]:
    """Seconds and nanoseconds of a stamp; negative ones become zero, which ROS reads as 'none'."""
    return divmod(max(int(stamp_ns), 0), SECOND_NS)
