"""The estimate of a training's time left, by a clock of the test's own."""

import numpy as np
import pytest

from tactile_perception.training.progress import TimeLeft

EPOCHS, STEPS, VALIDATION = 50, 300, 5.0


def run(seconds: np.ndarray) -> tuple[list[float], list[float | None]]:
    """Feed the steps' times, epochs by steps, and validations; what remained and was told after each step."""
    remaining = TimeLeft(EPOCHS, STEPS, batch_size=16, validation_samples=16 * STEPS // 3)
    left = float(seconds.sum()) + EPOCHS * VALIDATION
    truth, told = [], []
    for epoch, steps in enumerate(seconds):
        for step, taken in enumerate(steps):
            remaining.step(taken)
            left -= taken
            truth.append(left)
            told.append(remaining.seconds(epoch, step + 1))
        remaining.validation(VALIDATION)
        left -= VALIDATION
    return truth, told


def steady(seed: int = 0) -> np.ndarray:
    """Steps of 0.1 s, some of them a little longer."""
    return 0.1 + np.random.default_rng(seed).exponential(0.005, (EPOCHS, STEPS))


def disturbed(kind: str) -> np.ndarray:
    """Steps (EPOCHS, STEPS) in seconds of a run of half an hour."""
    seconds = steady()
    first = seconds[0]
    if kind == "warming up":
        first[:3] += [3.0, 1.0, 0.5]
    elif kind == "another program at the start":
        first[np.cumsum(first) < 4.5] *= 2.0
    elif kind == "frozen for some seconds":
        first[130] += 6.0
    elif kind == "slow at every tenth step":
        seconds[:, ::10] += 0.2
    return seconds


KINDS = [
    "steady", "warming up", "another program at the start", "frozen for some seconds",
    "slow at every tenth step",
]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_the_first_statement_is_within_a_fifth_of_what_remains(kind):
    truth, told = run(disturbed(kind))
    first = next(step for step, seconds in enumerate(told) if seconds is not None)
    assert first < STEPS, "nothing was told in the first epoch"
    assert told[first] == pytest.approx(truth[first], rel=0.2)


@pytest.mark.parametrize("kind", KINDS)
def test_later_statements_are_within_a_tenth(kind):
    truth, told = run(disturbed(kind))
    later = slice(STEPS, (EPOCHS - 1) * STEPS)
    np.testing.assert_allclose(told[later], truth[later], rtol=0.1)


def test_a_machine_that_gets_slower_is_followed_within_an_epoch():
    seconds = steady()
    seconds[10:] *= 3.0
    truth, told = run(seconds)
    assert told[11 * STEPS] == pytest.approx(truth[11 * STEPS], rel=0.05)


def test_nothing_is_told_before_enough_is_known():
    remaining = TimeLeft(epochs=3, steps=1000, batch_size=16, validation_samples=16)
    assert remaining.seconds(0) is None
    for step in range(19):
        remaining.step(30.0)  # long steps: a few say little
        assert remaining.seconds(0, step + 1) is None
    remaining.step(30.0)
    assert remaining.seconds(0, 20) is not None


def test_short_epochs_tell_as_soon_as_one_has_ended():
    remaining = TimeLeft(epochs=10, steps=5, batch_size=16, validation_samples=16)
    for step in range(5):
        remaining.step(0.1)
        assert remaining.seconds(0, step + 1) is None
    remaining.validation(0.25)
    assert remaining.seconds(1) == pytest.approx(9 * (0.5 + 0.25))
