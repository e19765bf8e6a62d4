"""Nanoseconds and the two numbers of a ROS Time or Duration."""

import pytest

from tactile_base.stamps import ns_from_parts, parts_from_ns


@pytest.mark.parametrize(
    ("ns", "parts"),
    [
        (0, (0, 0)),
        (999_999_999, (0, 999_999_999)),
        (1_795_260_791_630_780_636, (1_795_260_791, 630_780_636)),
        (-1, (-1, 999_999_999)),
        (-1_500_000_000, (-2, 500_000_000)),
    ],
)
def test_nanoseconds_are_parted_and_joined_exactly(ns, parts):
    assert parts_from_ns(ns) == parts
    assert ns_from_parts(*parts) == ns
