"""What `tactile data collect` shows: samples, pace and the time left."""

import math

import pytest
from rich.console import Console

from tactile_bringup.commands import collect_progress
from tactile_bringup.commands.collect_progress import CollectionDisplay, Pace, duration


class Said:
    """Progress of one arm, as the display takes it."""

    def __init__(self, phase: str, fraction: float, depth: float = math.nan) -> None:
        self.phase, self.fraction, self.depth, self.reason = phase, fraction, depth, ""


def test_the_pace_is_that_of_this_run_not_of_what_was_there_before():
    pace = Pace()
    pace.add(100, 10.0)
    assert math.isnan(pace.seconds())
    for done, now_s in ((100, 12.0), (101, 13.0), (102, 16.0), (102, 18.0)):
        pace.add(done, now_s)
    assert pace.seconds() == pytest.approx(3.0)


@pytest.mark.parametrize(
    "seconds, text", [(3.2, "3 s"), (75, "1 min 15 s"), (3600, "1 h 00 min"), (17000, "4 h 43 min")]
)
def test_durations_are_in_words(seconds, text):
    assert duration(seconds) == text


def test_lines_tell_samples_pace_and_time_left_and_finding_the_surface_does_not_count(monkeypatch, capsys):
    clock = iter([0.0, 60.0, 62.0, 64.0])
    monkeypatch.setattr(collect_progress.time, "monotonic", lambda: next(clock))
    monkeypatch.setattr(collect_progress, "LINE_PERIOD", 0.0)
    with CollectionDisplay(Console(force_terminal=False), live=False, samples=10) as display:
        for said in (Said("touch", 0.4), Said("rotate", 0.4), Said("shear", 0.5), Said("rotate", 0.6, 0.001)):
            display.update({"arm": ("", said)})
    last = capsys.readouterr().out.splitlines()[-1]
    assert "6 of 10 samples" in last and "2.00 s each" in last and "8 s left" in last and "1.00 mm" in last
