"""What `tactile data collect` shows while it works: samples, pace and the time left."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

from rich.console import Console, Group
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from tactile_bringup.launching.progress import LINE_PERIOD, MM, REFRESH_RATE, Display
from tactile_control.collection import REFERENCE, TOUCH
from tactile_control.phases import GO_TO_START

if TYPE_CHECKING:
    from tactile_bringup.launching.task_client import Progress


#: Phases before the first sample, which say nothing of the pace.
BEFORE_SAMPLES = (GO_TO_START, REFERENCE, TOUCH)


class Pace:
    """Seconds a sample, from the samples that this run has seen."""

    def __init__(self) -> None:
        self._first: tuple[int, float] | None = None
        self._last: tuple[int, float] | None = None

    def add(self, done: int, now_s: float) -> None:
        """Take in how many samples there are now."""
        if self._first is None:
            self._first = done, now_s
        if self._last is None or done > self._last[0]:
            self._last = done, now_s

    def seconds(self) -> float:
        """Seconds a sample; NaN before the first whole one."""
        if self._first is None or self._last is None or self._last[0] - self._first[0] < 1:
            return math.nan
        return (self._last[1] - self._first[1]) / (self._last[0] - self._first[0])


class CollectionDisplay(Display):
    """Shows how far the collection is.

    Parameters
    ----------
    samples : int
        That the folder is to hold.
    """

    def __init__(self, console: Console, live: bool, samples: int) -> None:
        super().__init__(console, live)
        self._samples = samples
        self._pace = Pace()
        self._said_s = -math.inf

    def update(self, arms: Mapping[str, tuple[str, Progress]]) -> None:
        """Show the collection of the one arm."""
        for _, progress in arms.values():
            if progress.phase:
                self._show(progress)

    def _show(self, progress: Progress) -> None:
        now = time.monotonic()
        done = round(progress.fraction * self._samples)
        if progress.phase not in BEFORE_SAMPLES:
            self._pace.add(done, now)
        if self._live is not None:
            if now - self._drawn_s >= 1.0 / REFRESH_RATE:
                self._drawn_s = now
                self._live.update(self._panel(progress, done))
        elif now - self._said_s >= LINE_PERIOD:
            self._said_s = now
            values = "  ".join(self._values(progress, done))
            self.say(f"  {progress.phase:<12} {values}" + (f"  {progress.reason}" if progress.reason else ""))

    def _panel(self, progress: Progress, done: int) -> Group:
        bar = Table.grid(padding=(0, 2))
        bar.add_row(ProgressBar(total=self._samples, completed=done, width=40), Text(progress.phase, "cyan"))
        values = Table.grid(padding=(0, 2))
        values.add_row(*self._values(progress, done))
        return Group(bar, values, Text(progress.reason, "yellow"))

    def _values(self, progress: Progress, done: int) -> list[str]:
        pace = self._pace.seconds()
        left = "-" if math.isnan(pace) else duration(pace * (self._samples - done))
        each = "-" if math.isnan(pace) else f"{pace:.2f} s"
        depth = "-" if math.isnan(progress.depth) else f"{progress.depth * MM:5.2f} mm"
        return [f"{done} of {self._samples} samples", f"{each} each", f"{left} left", f"depth {depth}"]


def duration(seconds: float) -> str:
    """Seconds in words: 45 s, 12 min 30 s, 3 h 05 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
