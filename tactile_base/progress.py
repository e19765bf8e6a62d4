"""Progress of something long: a bar with the time left on a terminal, a line now and then elsewhere.

One display for everything that takes a while. What is shown may change while it goes on: several things at
once, with a name each, numbers beside them, and lines that stay::

    with Progress() as progress:
        for done, item in enumerate(items, start=1):
            work(item)
            progress.update("training", done, len(items), "images")
        progress.say("trained")
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn
from rich.progress import Progress as Bars

from tactile_base.console import say

T = TypeVar("T")
P = TypeVar("P", bound="Progress")
LINE_PERIOD = 10.0  # s between lines where there is no terminal


class Progress:
    """Shows how far things are; use as a context.

    Parameters
    ----------
    console : rich.console.Console, optional
        Where to; default: standard error.
    live : bool, optional
        Whether to draw bars in place of lines; default: on a terminal.
    line_period : float
        Seconds between two lines of one thing whose state stays the same.
    """

    def __init__(
        self, console: Console | None = None, live: bool | None = None, line_period: float = LINE_PERIOD
    ) -> None:
        self.console = console or Console(stderr=True)
        live = self.console.is_terminal if live is None else live
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.fields[text]}", markup=False),
        )
        self._bars = Bars(*columns, console=self.console, transient=True) if live else None
        self._line_period = line_period
        self._things: dict[str, _Thing] = {}

    def __enter__(self: P) -> P:
        if self._bars is not None:
            self._bars.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._bars is not None:
            self._bars.stop()

    def say(self, text: str, style: str | None = None) -> None:
        """A line that stays."""
        say(self.console, text, style)

    def update(
        self,
        what: str,
        done: float = 0.0,
        total: float | None = None,
        unit: str = "",
        state: str = "",
        text: str = "",
        seconds_left: float | None = None,
    ) -> None:
        """Show how far the thing called `what` is.

        Parameters
        ----------
        done, total : float
            None: nobody knows how much there is, and what is done does not count for the pace.
        unit : str
            What is counted, as "images"; without one a percentage is shown.
        state : str
            What is going on in a word; where there is no terminal, a change of it is a line of its own.
        text : str
            Numbers worth watching.
        seconds_left : float, optional
            NaN: unknown. Default: by the pace since the first update with a total.
        """
        now_s = time.monotonic()
        thing = self._things.setdefault(what, _Thing(now_s))
        thing.done, pace_left = done, thing.seconds_left(now_s, done, total)
        left = pace_left if seconds_left is None else seconds_left
        parts = [state, _counted(done, total, unit), text]
        parts += [] if math.isnan(left) else [f"{duration(left)} left"]
        line = ", ".join(part for part in parts if part)
        if self._bars is not None:
            if thing.bar is None:
                thing.bar = self._bars.add_task(what, text="")
            self._bars.update(thing.bar, completed=done, total=total, text=line)
        elif thing.line_due(now_s, state, self._line_period):
            self.say(f"{what}: {line}" if line else what)

    def advance(self, what: str, count: float, total: float, unit: str = "") -> None:
        """Show that `count` more is done of the thing called `what`."""
        before = self._things[what].done if what in self._things else 0.0
        self.update(what, before + count, total, unit)

    def finish(self, what: str) -> None:
        """Take the thing's bar away; `update` starts it anew."""
        thing = self._things.pop(what, None)
        if thing is not None and thing.bar is not None and self._bars is not None:
            self._bars.remove_task(thing.bar)

    def counted(self, items: Iterable[T], what: str, total: int, unit: str = "") -> Iterator[T]:
        """The items, with their number and how many come a second shown as they come."""
        started_s = time.monotonic()
        for done, item in enumerate(items, start=1):
            rate = done / max(time.monotonic() - started_s, 1e-9)
            self.update(what, done, total, unit, text=f"{rate:.1f}/s")
            yield item
        self.finish(what)


class _Thing:
    """What is known of one thing that is shown."""

    def __init__(self, now_s: float) -> None:
        self.bar: TaskID | None = None
        self.done = 0.0
        self._state, self._line_s = "", now_s
        self._first: tuple[float, float] | None = None
        self._last: tuple[float, float] | None = None

    def seconds_left(self, now_s: float, done: float, total: float | None) -> float:
        """By the mean pace of what was done here (something may have been there before); NaN: unknown."""
        if total is None:
            return math.nan
        if self._first is None:
            self._first = done, now_s
        if self._last is None or done > self._last[0]:
            self._last = done, now_s
        progress = self._last[0] - self._first[0]
        if progress <= 0.0:
            return math.nan
        return (self._last[1] - self._first[1]) / progress * (total - done)

    def line_due(self, now_s: float, state: str, period_s: float) -> bool:
        """Whether to say something now; notes that it is said."""
        if state == self._state and now_s - self._line_s < period_s:
            return False
        self._state, self._line_s = state, now_s
        return True


def _counted(done: float, total: float | None, unit: str) -> str:
    if total is None:
        return f"{done:g} {unit}" if unit else ""
    return f"{done:g} of {total:g} {unit}" if unit else f"{done / total:.0%}" if total else ""


def duration(seconds: float) -> str:
    """Seconds in words: 45 s, 12 min 30 s, 3 h 05 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
