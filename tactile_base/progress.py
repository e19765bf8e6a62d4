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
from rich.progress import BarColumn, Task, TextColumn
from rich.progress import Progress as Bars

from tactile_base.console import say

T = TypeVar("T")
P = TypeVar("P", bound="Progress")
LINE_PERIOD = 10.0  # s between lines where there is no terminal


class Progress:
    """Shows how far things are; use as a context.

    Parameters
    ----------
    console : where to; default: standard error
    live : whether to draw bars in place of lines; default: on a terminal
    line_period : seconds between two lines of one thing whose state stays the same
    """

    def __init__(
        self, console: Console | None = None, live: bool | None = None, line_period: float = LINE_PERIOD
    ) -> None:
        self.console = console or Console(stderr=True)
        self._live = self.console.is_terminal if live is None else live
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.fields[text]}", markup=False),
        )
        self._bars = Bars(  # which know the pace, where none are drawn as well
            *columns, console=self.console, transient=True, disable=not self._live,
            speed_estimate_period=math.inf, get_time=lambda: time.monotonic(),
        )  # fmt: skip
        self._line_period = line_period
        self._tasks: dict[str, Task] = {}

    def __enter__(self: P) -> P:
        if self._live:  # else rich before 14 ends with an empty line
            self._bars.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._live:
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
        done, total : None: nobody knows how much there is, and what is done does not count for the pace
        unit : what is counted, as "images"; without one a percentage is shown
        state : what is going on in a word; where there is no terminal, a change of it is a line of its own
        text : numbers worth watching
        seconds_left : NaN: unknown; default: by the pace since the first update with a total
        """
        if what not in self._tasks:
            self._bars.add_task(what, total=None, text="", state="", line_s=time.monotonic())
            self._tasks[what] = self._bars.tasks[-1]
        task, now_s = self._tasks[what], time.monotonic()
        self._bars.update(task.id, completed=done, total=total)
        if seconds_left is None:
            seconds_left = (total - done) / task.speed if total is not None and task.speed else math.nan
        parts = [state, _counted(done, total, unit), text]
        parts += [] if math.isnan(seconds_left) else [f"{duration(seconds_left)} left"]
        line = ", ".join(part for part in parts if part)
        self._bars.update(task.id, text=line)
        due = state != task.fields["state"] or now_s - task.fields["line_s"] >= self._line_period
        if due and not self._live:
            task.fields |= {"state": state, "line_s": now_s}
            self.say(f"{what}: {line}" if line else what)

    def advance(self, what: str, count: float, total: float, unit: str = "") -> None:
        """Show that `count` more is done of the thing called `what`."""
        before = self._tasks[what].completed if what in self._tasks else 0.0
        self.update(what, before + count, total, unit)

    def finish(self, what: str) -> None:
        """Take the thing's bar away; `update` starts it anew."""
        if what in self._tasks:
            self._bars.remove_task(self._tasks.pop(what).id)

    def counted(self, items: Iterable[T], what: str, total: int, unit: str = "") -> Iterator[T]:
        """The items, with their number and how many come a second shown as they come."""
        started_s = time.monotonic()
        for done, item in enumerate(items, start=1):
            rate = done / max(time.monotonic() - started_s, 1e-9)
            self.update(what, done, total, unit, text=f"{rate:.1f}/s")
            yield item
        self.finish(what)


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
