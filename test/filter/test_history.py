"""Estimates that come late: the result is that of estimates that came in order, to the bit."""

import numpy as np
import pytest
from contact_case import CONTACT, SIGMA
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_base.settings import SettingError
from tactile_filter import history
from tactile_filter.bayes_filter import BeliefFlag, ContactFilter, FilterSettings
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

MS = 1_000_000
PERIOD = 8 * MS
KEEPING = FilterSettings(history=0.1, gate_probability=0.99, reinitialize_after=2, robust="student_t")


def inputs(count, seed):
    """Inputs in order: good ones, outliers, broken ones, broken sensor poses, some with equal stamps."""
    rng = np.random.default_rng(seed)
    made, stamp, sensor = [], 0, np.eye(4)
    for k in range(count):
        stamp += 0 if rng.random() < 0.1 else PERIOD
        sensor = sensor @ se3.exp(1e-3 * rng.normal(size=6))
        kind = rng.choice(["good", "outlier", "broken", "lost"], p=[0.7, 0.15, 0.1, 0.05])
        scale = 30.0 if kind == "outlier" else 1.0
        cov = np.diag(SIGMA**2) * (np.nan if kind == "broken" else 1.0)
        estimate = PoseGaussian(se3.exp(scale * SIGMA * rng.normal(size=6)) @ CONTACT, cov)
        pose = np.full((4, 4), np.nan) if kind == "lost" else se3.orthonormalized(sensor)
        made.append((stamp, estimate, pose, "camera", k))
    return made


def fed(made, filter_settings=KEEPING):
    contact_filter = ContactFilter(filter_settings)
    beliefs = [
        contact_filter.step(stamp, estimate, pose, source=source, sequence=sequence)
        for stamp, estimate, pose, source, sequence in made
    ]
    return contact_filter, beliefs


def assert_same(found, expected):
    np.testing.assert_array_equal(found.mean, expected.mean)
    np.testing.assert_array_equal(found.cov, expected.cov)
    np.testing.assert_array_equal(found.nis, expected.nis)
    assert (found.stamp_ns, found.flags, found.reason, found.rejected) == (
        expected.stamp_ns, expected.flags, expected.reason, expected.rejected,
    )  # fmt: skip


def shuffled(made, reach, seed):
    """Arrival order in which no input comes more than `reach` places late."""
    rng = np.random.default_rng(seed)
    return [made[i] for i in np.argsort(np.arange(len(made)) + rng.uniform(0.0, reach, len(made)))]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 10**6), st.integers(2, 11))
def test_any_order_of_arrival_within_the_history_gives_the_bits_of_the_right_order(seed, order, reach):
    made = inputs(40, seed)
    plain, beliefs = fed(made, KEEPING.replaced(history=0.0))
    late, found = fed(shuffled(made, reach, order))
    assert late.late["too late"] == 0
    assert_same(found[-1], beliefs[-1])
    assert late.rejections == plain.rejections
    assert late.resets == plain.resets
    after = made[-1][0] + PERIOD
    assert_same(late.predict_to(after, np.eye(4)), plain.predict_to(after, np.eye(4)))


def test_shuffling_does_make_inputs_late_and_keeps_them_all():
    late, _ = fed(shuffled(inputs(40, 3), 8, 4))
    assert late.late["put in place"] > 5
    assert late.late["too late"] == 0


def test_in_order_a_history_changes_nothing():
    made = inputs(60, 5)
    _, plain = fed(made, KEEPING.replaced(history=0.0))
    _, kept = fed(made)
    for found, expected in zip(kept, plain, strict=True):
        assert_same(found, expected)


def good(stamp, shift=0.0):
    return (
        stamp, PoseGaussian(se3.exp([shift, 0, 0, 0, 0, 0]) @ CONTACT, np.diag(SIGMA**2)), np.eye(4), "", 0
    )  # fmt: skip


def test_what_is_older_than_the_history_is_refused_counted_and_named():
    contact_filter, _ = fed([good(k * PERIOD) for k in range(40)])
    expected = contact_filter.predict_to(39 * PERIOD, np.eye(4))
    belief = contact_filter.step(39 * PERIOD - 101 * MS, *good(0)[1:3])
    assert "is too late: the last is of 312000000 ns, and the history is 0.1 s" in belief.reason
    assert belief.flags == BeliefFlag.PREDICTED_ONLY
    assert belief.rejected == contact_filter.rejections["too late"] == contact_filter.late["too late"] == 1
    np.testing.assert_array_equal(belief.cov, expected.cov)
    assert contact_filter.step(40 * PERIOD, *good(0)[1:3]).rejected == 1


def test_a_late_estimate_improves_the_belief():
    """As two filters would: one that got all, one that never got the fifth."""
    made = [good(k * PERIOD, 1e-4 * k) for k in range(8)]
    _, complete = fed(made)
    without = made[:5] + made[6:]
    contact_filter, lacking = fed(without)
    late = contact_filter.step(*made[5][:3])
    np.testing.assert_array_equal(late.mean, complete[-1].mean)
    assert not np.array_equal(lacking[-1].mean, late.mean)


def test_time_that_jumps_back_still_restarts_the_filter():
    contact_filter, _ = fed([good(10_000 * MS + k * PERIOD) for k in range(5)])
    belief = contact_filter.step(*good(0)[:3])
    assert belief.reason == "time jumped back"
    assert contact_filter.resets["time jumped back"] == 1
    early = contact_filter.step(*good(-PERIOD)[:3])
    assert early.stamp_ns == 0
    assert early.flags == BeliefFlag.MEASUREMENT_FUSED
    assert contact_filter.resets["time jumped back"] == 1


def test_settings_hold_from_the_step_at_which_they_were_changed_even_when_steps_are_taken_again():
    made = [good(k * PERIOD, 1e-4 * k) for k in range(8)]

    def run(order):
        contact_filter = ContactFilter(KEEPING)
        for k in order:
            contact_filter.configure(KEEPING.replaced(process_noise_translation=1e-3 if k > 4 else 1e-4))
            belief = contact_filter.step(*made[k][:3])
        return belief

    assert_same(run([0, 2, 1, 3, 5, 4, 7, 6]), run(range(8)))


def test_after_a_reset_at_a_stamp_what_was_measured_before_it_is_too_late():
    contact_filter, _ = fed([good(k * PERIOD) for k in range(5)])
    contact_filter.reset("no contact", 5 * PERIOD)
    assert "too late" in contact_filter.step(*good(4 * PERIOD)[:3]).reason
    assert not contact_filter.has_belief
    assert contact_filter.step(*good(6 * PERIOD)[:3]).flags & BeliefFlag.REINITIALIZED


def test_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(history, "CAPACITY", 16)
    contact_filter, _ = fed([good(k * MS // 10) for k in range(400)])
    assert len(contact_filter._history) == 16
    assert "too late" in contact_filter.step(MS, *good(0)[1:3]).reason
    contact_filter.configure(KEEPING.replaced(history=0.0))
    assert len(contact_filter._history) == 0


def test_a_history_longer_than_what_counts_as_a_jump_is_refused():
    with pytest.raises(SettingError, match=r"history = 2 s: must not be longer than backward_jump = 1 s"):
        FilterSettings(history=2.0)


@pytest.mark.parametrize("other", ["camera_a", "camera_c"])
def test_equal_stamps_are_ordered_by_source_not_by_arrival(other):
    first, second = good(PERIOD, 1e-4), good(PERIOD, -1e-4)

    def run(order):
        contact_filter = ContactFilter(KEEPING)
        contact_filter.step(*good(0)[:3])
        for source, made in order:
            belief = contact_filter.step(*made[:3], source=source)
        return belief

    pair = [("camera_b", first), (other, second)]
    assert_same(run(pair), run(pair[::-1]))
