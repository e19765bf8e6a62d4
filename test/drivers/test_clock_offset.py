"""The offset of a device's clock, against clocks and delays that are made up."""

import numpy as np
import pytest

from tactile_base.stamps import SECOND_NS
from tactile_drivers.commanded_motion import ClockOffset

FLOOR = 0.0003  # s: the smallest delay, which nobody can know


def errors(drift: float, seconds: float, rate: float = 125.0, seed: int = 1, jitter: float = 0.002):
    """Errors (s) of the stamps of a device whose clock is slower by `drift`, and what is tracked."""
    rng, clock = np.random.default_rng(seed), ClockOffset()
    sent = np.arange(0.0, seconds, 1.0 / rate)
    delays = FLOOR + rng.exponential(jitter, len(sent)) * (rng.random(len(sent)) < 0.7)
    found = []
    for ours, delay in zip(sent, delays, strict=True):
        device = 500.0 + ours * (1.0 - drift)
        stamp = clock.stamp_ns(device, round((1e6 + ours + delay) * SECOND_NS))
        found.append(stamp / SECOND_NS - (1e6 + ours))
    return np.array(found), clock.drift


@pytest.mark.parametrize("drift", [-100e-6, -20e-6, 0.0, 20e-6, 100e-6])
def test_stamps_are_right_within_half_a_millisecond_of_the_smallest_delay_for_an_hour(drift: float):
    found, tracked = errors(drift, 3600.0, rate=20.0)
    assert np.abs(found[1000:] - FLOOR).max() < 5e-4
    assert tracked == pytest.approx(drift, abs=2e-6)


def test_jitter_of_twenty_milliseconds_moves_no_stamp_by_a_millisecond():
    found, _ = errors(50e-6, 60.0, jitter=0.02)
    assert np.abs(found[1000:] - FLOOR).max() < 1e-3


def test_a_message_that_is_held_up_keeps_the_time_at_which_it_was_sent():
    clock = ClockOffset()
    for k in range(100):
        clock.stamp_ns(k * 0.01, k * 10_000_000)
    assert clock.stamp_ns(1.0, 1_500_000_000) == pytest.approx(1_000_000_000, abs=10_000)


def test_a_clock_that_was_started_anew_is_followed_at_once():
    clock = ClockOffset()
    clock.stamp_ns(1000.0, 5 * SECOND_NS)
    assert clock.stamp_ns(2.0, 6 * SECOND_NS) == 6 * SECOND_NS
    assert clock.stamp_ns(2.5, 6 * SECOND_NS + SECOND_NS // 2 + 7000) == pytest.approx(
        6.5 * SECOND_NS, abs=2e5
    )
