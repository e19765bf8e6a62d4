"""Progress of something long, on a terminal and elsewhere, by a clock of the test's own."""

import io

import pytest
from rich.console import Console

from tactile_base import progress as module
from tactile_base.progress import Progress, duration


class Clock:
    """Seconds as the test sets them."""

    now_s = 0.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    return clock


def plain() -> tuple[Console, io.StringIO]:
    """No terminal, and what it was given."""
    text = io.StringIO()
    return Console(file=text, force_terminal=False, width=60), text


@pytest.mark.parametrize(
    "seconds, text",
    [(3.2, "3 s"), (59.6, "1 min 00 s"), (75, "1 min 15 s"), (3600, "1 h 00 min"), (17000, "4 h 43 min")],
)
def test_durations_are_in_words(seconds, text):
    assert duration(seconds) == text


def test_without_a_terminal_a_line_comes_now_and_then_with_count_and_time_left(clock):
    console, text = plain()
    with Progress(console, line_period=10.0) as progress:
        for done in range(1, 31):
            clock.now_s += 1.0
            progress.update("reading", done, 100, "images", text="1.0/s")
    assert text.getvalue().splitlines() == [
        f"reading: {done} of 100 images, 1.0/s, {duration(100 - done)} left" for done in (11, 21)
    ]


def test_a_change_of_state_is_a_line_at_once_and_a_share_is_a_percentage(clock):
    console, text = plain()
    with Progress(console) as progress:
        for state, share in (("approach", 0.0), ("approach", 0.0), ("follow", 0.0), ("follow", 0.25)):
            clock.now_s += 1.0
            progress.update("left", share, 1.0, state=state)
        progress.say("left: arrived [after] 4 s")
    assert text.getvalue().splitlines() == [
        "left: approach, 0%", "left: follow, 0%", "left: arrived [after] 4 s",
    ]  # fmt: skip


def test_the_pace_is_that_of_this_run_and_not_of_what_was_there_or_of_getting_ready(clock):
    console, text = plain()
    with Progress(console, line_period=0.0) as progress:
        progress.update("collecting", 100, None, "samples", state="touch")
        clock.now_s = 60.0
        for done in (100, 101, 102):
            progress.update("collecting", done, 110, "samples", state="shear")
            clock.now_s += 2.0
    lines = text.getvalue().splitlines()
    assert lines[0] == "collecting: touch, 100 samples"
    assert lines[1] == "collecting: shear, 100 of 110 samples"
    assert lines[-1] == "collecting: shear, 102 of 110 samples, 16 s left"


def test_a_time_left_that_is_known_better_is_shown_and_one_that_is_unknown_is_not(clock):
    console, text = plain()
    with Progress(console, line_period=0.0) as progress:
        for done, left in ((1, 3600.0), (2, float("nan"))):
            clock.now_s += 1.0
            progress.update("training", done, 10, "steps", seconds_left=left)
    assert text.getvalue().splitlines() == [
        "training: 1 of 10 steps, 1 h 00 min left", "training: 2 of 10 steps",
    ]  # fmt: skip


def test_items_pass_through_with_their_rate(clock):
    def items():
        for item in "abc":
            clock.now_s += 0.5
            yield item

    console, text = plain()
    with Progress(console, line_period=0.0) as progress:
        assert list(progress.counted(items(), "train", 3, "samples")) == ["a", "b", "c"]
    assert text.getvalue().splitlines()[1] == "train: 2 of 3 samples, 2.0/s, 0 s left"


def test_what_comes_in_lots_adds_up(clock):
    console, text = plain()
    with Progress(console, line_period=0.0) as progress:
        for _ in range(2):
            progress.advance("predicting", 50, 150, "images")
            clock.now_s += 3.0
    assert text.getvalue().splitlines()[1] == "predicting: 100 of 150 images, 3 s left"


def test_on_a_terminal_there_are_bars_that_go_away_and_lines_that_stay():
    text = io.StringIO()
    console = Console(file=text, force_terminal=True, width=100, _environ={"TERM": "xterm"})
    with Progress(console) as progress:
        progress.update("loading", 3, 4, "images")
        progress.finish("loading")
        progress.update("training", 1, 4, text="loss [1.0]")
        progress.say("epoch 1")
    shown = text.getvalue()
    assert "training" in shown and "25%, loss [1.0]" in shown and "epoch 1\n" in shown.replace("\r", "")
    assert "\x1b[2K" in shown  # lines are erased
