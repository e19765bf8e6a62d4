"""What `tactile data collect` shows: samples, pace and the time left."""

import math

from rich.console import Console

from tactile_base import progress
from tactile_bringup.launching.progress import CollectionDisplay


class Said:
    """Progress of one arm, as the display takes it."""

    def __init__(self, phase: str, fraction: float, depth: float = math.nan) -> None:
        self.phase, self.fraction, self.depth, self.reason = phase, fraction, depth, ""


def test_lines_tell_samples_and_time_left_and_finding_the_surface_does_not_count(monkeypatch, capsys):
    said = (Said("touch", 0.4), Said("rotate", 0.4), Said("shear", 0.5), Said("rotate", 0.6, 0.001))
    with CollectionDisplay(Console(force_terminal=False), live=False, samples=10) as display:
        for now_s, one in zip((0.0, 60.0, 71.0, 82.0), said, strict=True):
            monkeypatch.setattr(progress.time, "monotonic", lambda now_s=now_s: now_s)
            display.show("arm", "", one)
    first, *_, last = capsys.readouterr().out.splitlines()
    assert first == "arm: 4 of 10 samples, rotate"
    assert last == "arm: 6 of 10 samples, rotate, depth  1.00 mm, 44 s left"
