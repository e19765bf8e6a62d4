"""Stamps and durations: whole nanoseconds as int, which Python, ROS and a bag all hold exactly."""

from __future__ import annotations

SECOND_NS = 1_000_000_000
NANOSECOND = 1e-9  # s


def ns_from_parts(sec: int, nanosec: int) -> int:
    """Nanoseconds of the two numbers that a ROS Time or Duration holds."""
    return int(sec) * SECOND_NS + int(nanosec)


def parts_from_ns(ns: int) -> tuple[int, int]:
    """The two numbers of a ROS Time or Duration: of a negative one, `sec` alone is negative."""
    return divmod(int(ns), SECOND_NS)
