"""The tangent-space PID against sums and differences written out by hand, and at the edges of its inputs."""

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_base.settings import SettingError
from tactile_control.pid import (
    DERIVATIVE,
    FEEDBACK,
    INTEGRAL,
    PROPORTIONAL,
    ControlInputError,
    PidSettings,
    TangentPid,
    tangent_error,
    to_local,
)
from tactile_geometry import se3

STEP = 16_000_000
DT = STEP * 1e-9
GAINS = {"kp": [2.0] * 6, "ki": [0.7] * 6, "kd": [0.3] * 6}


def errors(n, seed=0):
    return np.random.default_rng(seed).standard_normal((n, 6)) * 0.01


def test_output_equals_the_written_out_sums():
    settings = PidSettings(**GAINS, ewma_decay=0.5)
    pid, e = TangentPid(settings), errors(40)
    got = np.array([pid.update(k * STEP, e[k])[FEEDBACK] for k in range(40)])
    integral, smooth, expected = np.zeros(6), e[0], [2.0 * e[0]]
    for k in range(1, 40):
        integral = integral + e[k] * DT
        before, smooth = smooth, 0.5 * smooth + 0.5 * e[k]
        expected.append(2.0 * e[k] + 0.7 * integral + 0.3 * (smooth - before) / DT)
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-15)


def test_first_step_has_neither_derivative_nor_integral():
    out = TangentPid(PidSettings(**GAINS)).update(5, np.ones(6))
    assert not out[DERIVATIVE].any() and not out[INTEGRAL].any()
    np.testing.assert_array_equal(out[FEEDBACK], 2.0 * np.ones(6))


def test_derivative_of_a_steady_slope_is_the_slope_whatever_the_smoothing():
    pid = TangentPid(PidSettings(kd=[1.0] * 6, ewma_decay=0.5))
    for k in range(200):
        out = pid.update(k * STEP, np.full(6, 0.1 * k * DT))
    np.testing.assert_allclose(out[DERIVATIVE], 0.1, rtol=1e-9)


def test_integral_is_clipped_per_channel_and_leaves_the_clip_at_once():
    limit = [0.025, 0.025, 0.025, 25.0, 25.0, 25.0]
    pid = TangentPid(PidSettings(ki=[1.0] * 6, integral_limit=limit))
    for k in range(3000):
        out = pid.update(k * STEP, np.ones(6))
    np.testing.assert_allclose(out[INTEGRAL], limit)
    out = pid.update(3000 * STEP, -np.ones(6))
    np.testing.assert_allclose(out[INTEGRAL], np.array(limit) - DT)


def test_integral_does_not_wind_up_while_the_output_is_clipped():
    pid = TangentPid(PidSettings(kp=[2.0] * 6, ki=[1.0] * 6, output_limit=[0.5] * 6))
    for k in range(500):
        out = pid.update(k * STEP, np.ones(6))
    assert (out[FEEDBACK] != out[PROPORTIONAL:].sum(axis=0)).all() and not pid.integral.any()
    np.testing.assert_array_equal(out[FEEDBACK], 0.5)
    out = pid.update(500 * STEP, np.full(6, -0.1))
    assert (out[FEEDBACK] < 0.0).all()


def test_integral_held_on_request():
    pid = TangentPid(PidSettings(ki=[1.0] * 6))
    pid.update(0, np.ones(6))
    pid.update(STEP, np.ones(6), hold_integral=True)
    assert not pid.integral.any()


def test_time_comes_from_stamps_even_when_steps_are_uneven():
    pid = TangentPid(PidSettings(ki=[1.0] * 6))
    for stamp in (0, 3_000_000, 50_000_000, 60_000_000):
        out = pid.update(stamp, np.ones(6))
    np.testing.assert_allclose(out[INTEGRAL], 0.06)


def test_a_gap_neither_kicks_the_derivative_nor_fills_the_integral():
    pid = TangentPid(PidSettings(**GAINS, longest_step=0.1))
    pid.update(0, np.zeros(6))
    out = pid.update(60 * 10**9, np.ones(6))
    assert not out[DERIVATIVE].any()
    np.testing.assert_allclose(out[INTEGRAL], 0.7 * 0.1)


@pytest.mark.parametrize("stamp", [100, 99])
def test_a_stamp_that_is_not_later_is_refused_and_changes_nothing(stamp):
    pid = TangentPid(PidSettings(**GAINS))
    pid.update(100, np.ones(6))
    with pytest.raises(ControlInputError, match=f"stamp {stamp} ns is not later than the last one, 100 ns"):
        pid.update(stamp, np.ones(6))
    assert pid.stamp_ns == 100 and not pid.integral.any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e308, -2e3])
def test_a_number_that_is_no_error_is_refused_by_channel_and_changes_nothing(bad):
    pid = TangentPid(PidSettings(**GAINS))
    pid.update(0, np.ones(6))
    error = np.ones(6)
    error[4] = bad
    with pytest.raises(ControlInputError, match="error is no number within 1000: phi_y"):
        pid.update(STEP, error)
    np.testing.assert_allclose(pid.update(STEP, np.ones(6))[INTEGRAL], 0.7 * DT)


def test_new_gains_do_not_make_the_output_jump_and_take_over_in_time():
    pid = TangentPid(PidSettings(**GAINS, transfer_time=0.5))
    e = np.linspace(0.01, 0.06, 6)
    for k in range(100):
        before = pid.update(k * STEP, e)[FEEDBACK]
    new = PidSettings(kp=[9.0] * 6, ki=[0.0] * 6, kd=[1.0] * 6, integral_limit=[1e-3] * 6, transfer_time=0.5)
    pid.configure(new)
    after = pid.update(100 * STEP, e)[FEEDBACK]
    step_of_fade = (1.0 - np.exp(-DT / 0.5)) * np.abs(9.0 * e - before).max()
    assert np.abs(after - before).max() <= step_of_fade * 1.0001
    for k in range(101, 600):
        out = pid.update(k * STEP, e)
    np.testing.assert_allclose(out[FEEDBACK], 9.0 * e, rtol=1e-4)


def test_gains_changed_again_during_the_transfer_still_do_not_jump():
    pid = TangentPid(PidSettings(**GAINS))
    for k in range(10):
        pid.update(k * STEP, np.ones(6))
    pid.configure(PidSettings(kp=[5.0] * 6))
    before = pid.update(10 * STEP, np.ones(6))[FEEDBACK]
    pid.configure(PidSettings(kp=[1.0] * 6))
    after = pid.update(11 * STEP, np.ones(6))[FEEDBACK]
    assert np.abs(after - before).max() < 0.25  # the gains differ by 4


def test_reset_forgets_everything():
    pid, fresh = TangentPid(PidSettings(**GAINS)), TangentPid(PidSettings(**GAINS))
    for k in range(20):
        pid.update(k * STEP, np.ones(6))
    pid.reset()
    for k, e in enumerate(errors(5)):
        np.testing.assert_array_equal(pid.update(k, e)[FEEDBACK], fresh.update(k, e)[FEEDBACK])


@pytest.mark.parametrize(
    "values",
    [
        {"kp": [1.0] * 5},
        {"kp": [-1.0] * 6},
        {"ewma_decay": 1.0},
        {"ki": [np.nan] * 6},
        {"kp": [np.inf] * 6},
        {"kd": [1e308] * 6},
    ],
)
def test_settings_that_make_no_sense_are_refused(values):
    with pytest.raises(SettingError):
        PidSettings(**values)


numbers = st.floats() | st.sampled_from([np.nan, np.inf, -np.inf, 1e308, -1e308, 0.0, 1e-3])
sixes = st.lists(numbers, min_size=6, max_size=6)
gains = st.fixed_dictionaries(
    {}, optional=dict.fromkeys(("kp", "ki", "kd", "integral_limit", "output_limit"), sixes)
)


@given(st.lists(st.tuples(sixes, gains, st.integers(-1, 10**12)), max_size=20))
def test_no_input_and_no_gain_leaves_anything_behind_that_is_not_finite(steps):
    pid, stamp = TangentPid(PidSettings(**GAINS)), 0
    for error, changes, elapsed in steps:
        with contextlib.suppress(SettingError):
            pid.configure(PidSettings(**changes))
        with contextlib.suppress(ControlInputError):
            assert np.isfinite(pid.update(stamp + elapsed, error)[FEEDBACK]).all()
            stamp += elapsed
    pid.configure(PidSettings(**GAINS))
    out = pid.update(stamp + 10**12, errors(1)[0])
    assert all(np.isfinite(part).all() for part in out)


tangents = st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6).map(np.array)


@given(tangents, tangents)
def test_errors_lead_from_the_pose_to_the_reference(a, b):
    X, X_reference = se3.exp(a), se3.exp(b)
    np.testing.assert_allclose(X @ se3.exp(tangent_error(X, X_reference, "local")), X_reference, atol=1e-9)
    np.testing.assert_allclose(se3.exp(tangent_error(X, X_reference, "global")) @ X, X_reference, atol=1e-9)


@given(tangents, tangents)
def test_the_adjoint_maps_between_the_two_tangent_spaces(a, b):
    X, X_reference = se3.exp(a), se3.exp(b)
    local, world = tangent_error(X, X_reference, "local"), tangent_error(X, X_reference, "global")
    np.testing.assert_allclose(to_local(world, X, "global"), local, atol=1e-8)
    np.testing.assert_allclose(se3.adjoint(X) @ local, world, atol=1e-8)


def test_an_unknown_tangent_space_is_refused_with_the_choices():
    with pytest.raises(ValueError, match="must be one of local, global"):
        tangent_error(np.eye(4), np.eye(4), "body")
