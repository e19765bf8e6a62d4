"""Stamps of messages as int nanoseconds, and back."""

from __future__ import annotations

from builtin_interfaces.msg import Duration, Time

from tactile_base.stamps import ns_from_parts, parts_from_ns


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
