"""Stamps as int nanoseconds."""

from __future__ import annotations

from builtin_interfaces.msg import Duration, Time

SECOND_NS = 1_000_000_000


def ns_from_time(stamp: Time | Duration) -> int:
    """Nanoseconds of a Time or Duration message."""
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def time_from_ns(stamp_ns: int) -> Time:
    """Time message of nanoseconds since the epoch; negative ones become zero, which ROS reads as 'none'."""
    sec, nanosec = divmod(max(int(stamp_ns), 0), SECOND_NS)
    return Time(sec=sec, nanosec=nanosec)


def duration_from_ns(duration_ns: int) -> Duration:
    """Duration message of nanoseconds."""
    sec, nanosec = divmod(int(duration_ns), SECOND_NS)
    return Duration(sec=sec, nanosec=nanosec)
