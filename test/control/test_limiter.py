"""The limiter never exceeds its limits, whatever it is fed, and says what it did."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tactile_control.limiter import LimiterSettings, TwistLimiter

STEP = 10_000_000
SETTINGS = LimiterSettings(
    linear_speed=0.05, angular_speed=0.5, linear_acceleration=0.5, angular_acceleration=5.0
)
anything = st.lists(
    st.floats(allow_nan=True, allow_infinity=True) | st.floats(-1, 1), min_size=6, max_size=6
).map(np.array)


def settled(wanted, steps=200):
    limiter = TwistLimiter(SETTINGS)
    for k in range(steps):
        out = limiter.step(k * STEP, wanted)
    return out


def test_a_twist_within_the_limits_passes_unchanged():
    wanted = np.array([0.01, 0.02, 0.0, 0.1, 0.0, 0.2])
    out = settled(wanted)
    np.testing.assert_array_equal(out.twist, wanted)
    assert not out.reason


def test_speed_is_limited_by_norm_and_keeps_its_direction():
    out = settled(np.array([0.3, 0.4, 0.0, 0.0, 0.0, 2.0]))
    np.testing.assert_allclose(out.twist, [0.03, 0.04, 0.0, 0.0, 0.0, 0.5])
    assert "linear speed 0.5 over 0.05 m/s" in out.reason and "angular speed 2 over 0.5 rad/s" in out.reason


def test_it_starts_from_rest_and_accelerates_within_the_limit():
    limiter, wanted = TwistLimiter(SETTINGS), np.array([0.05, 0, 0, 0, 0, 0.0])
    twists = np.array([limiter.step(k * STEP, wanted).twist[0] for k in range(12)])
    np.testing.assert_allclose(twists[:11], 0.005 * np.arange(11), atol=1e-12)


@given(
    st.lists(anything, min_size=1, max_size=30),
    st.lists(st.integers(-(10**9), 10**9), min_size=30, max_size=30),
)
def test_no_input_gets_past_the_limits(twists, steps):
    limiter, now, last = TwistLimiter(SETTINGS), 0, np.zeros(6)
    for twist, step in zip(twists, steps, strict=False):
        now += step
        out = limiter.step(now, twist).twist
        assert np.isfinite(out).all()
        assert np.linalg.norm(out[:3]) <= 0.05 * (1 + 1e-9) and np.linalg.norm(out[3:]) <= 0.5 * (1 + 1e-9)
        assert np.linalg.norm(out[:3] - last[:3]) <= 0.5 * 0.05 * (1 + 1e-6)
        last = out


def test_not_a_number_decelerates_to_rest_and_says_why():
    limiter = TwistLimiter(SETTINGS)
    for k in range(50):
        limiter.step(k * STEP, np.array([0.05, 0, 0, 0, 0, 0]))
    bad = np.array([0.05, np.nan, 0, 0, np.inf, 0])
    speeds = []
    for k in range(50, 65):
        out = limiter.step(k * STEP, bad)
        speeds.append(out.twist[0])
        assert "not finite in rho_y, phi_y: decelerating to rest" in out.reason
    assert speeds == sorted(speeds, reverse=True) and speeds[0] > 0.04 and speeds[-1] == 0.0


def test_a_twist_of_the_wrong_shape_is_refused_in_words():
    out = TwistLimiter(SETTINGS).step(0, np.ones(3))
    assert "shape (3,)" in out.reason and not out.twist.any()


def test_new_limits_hold_from_the_next_step_without_a_jump():
    limiter = TwistLimiter(SETTINGS)
    for k in range(50):
        limiter.step(k * STEP, np.array([0.05, 0, 0, 0, 0, 0]))
    limiter.configure(SETTINGS.replaced(linear_speed=0.01))
    speeds = [limiter.step((50 + k) * STEP, np.array([0.05, 0, 0, 0, 0, 0])).twist[0] for k in range(20)]
    assert speeds[0] >= 0.05 - 0.5 * 0.0101 and speeds[-1] == 0.01
