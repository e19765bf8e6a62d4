"""Progress of making data: a bar with the time left on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tactile_bringup.commands.collect_progress import duration

T = TypeVar("T")
LINE_PERIOD = 10.0  # s


def counted(items: Iterable[T], text: str, total: int, console: Console) -> Iterator[T]:
    """The items, with progress shown as they come."""
    if console.is_terminal:
        columns = (
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
            TextColumn("{task.fields[pace]}"), TimeRemainingColumn(),
        )  # fmt: skip
        started = time.monotonic()
        with Progress(*columns, console=console, transient=True, speed_estimate_period=60.0) as progress:
            task = progress.add_task(text, total=total, pace="")
            for done, item in enumerate(items, start=1):
                progress.update(task, completed=done, pace=_pace(done, time.monotonic() - started))
                yield item
    else:
        yield from _with_lines(items, text, total, console)


def _with_lines(items: Iterable[T], text: str, total: int, console: Console) -> Iterator[T]:
    started = said = time.monotonic()
    for done, item in enumerate(items, start=1):
        now = time.monotonic()
        if now - said >= LINE_PERIOD:
            said, elapsed = now, now - started
            left = duration(elapsed / done * (total - done))
            console.print(f"{text}: {done} done, {_pace(done, elapsed)}, {left} left", highlight=False)
        yield item


def _pace(done: int, elapsed_s: float) -> str:
    return f"{done / max(elapsed_s, 1e-9):.1f}/s"
