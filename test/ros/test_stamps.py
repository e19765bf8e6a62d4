"""Stamps as nanoseconds and as messages."""

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not in this environment: make, then . scripts/env.sh")

from tactile_ros.conversions import duration_from_ns, ns_from_time, time_from_ns


@pytest.mark.parametrize("stamp_ns", [0, 1, 999_999_999, 1_000_000_000, 1_795_260_791_630_780_636])
def test_stamps_survive_the_way_through_a_message(stamp_ns):
    assert ns_from_time(time_from_ns(stamp_ns)) == stamp_ns


def test_negative_durations_survive_and_negative_stamps_mean_none():
    assert ns_from_time(duration_from_ns(-1_500_000_000)) == -1_500_000_000
    assert ns_from_time(time_from_ns(-5)) == 0
