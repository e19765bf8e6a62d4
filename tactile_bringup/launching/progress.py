"""What `tactile launch` shows while it works: a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from tactile_bringup.launching.task_client import Progress

LINE_PERIOD = 2.0  # s between plain lines of one phase
REFRESH_RATE = 8  # 1/s
MM, DEGREES, MS = 1e3, 180.0 / math.pi, 1e3


class Display:
    """Shows headlines and the progress of each arm.

    Parameters
    ----------
    console : rich.console.Console
        Where to.
    live : bool
        Whether to redraw in place; only on a terminal.
    """

    def __init__(self, console: Console, live: bool) -> None:
        self._console = console
        self._live = Live(console=console, refresh_per_second=REFRESH_RATE, transient=True) if live else None
        self._shown: dict[str, tuple[str, float]] = {}
        self._drawn_s = -math.inf

    def __enter__(self) -> Display:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._live is not None:
            self._live.stop()

    def say(self, text: str, style: str | None = None) -> None:
        """A line that stays."""
        self._console.print(Text(text, style or ""), soft_wrap=True)

    def update(self, arms: Mapping[str, tuple[str, Progress]]) -> None:
        """Show how far each arm is with its goal, which is given by a label."""
        now = time.monotonic()
        if self._live is not None and now - self._drawn_s >= 1.0 / REFRESH_RATE:
            self._drawn_s = now
            self._live.update(_panel(arms))
        elif self._live is None:
            for arm, (label, progress) in arms.items():
                self._line(now, label, arm, progress)

    def _line(self, now: float, label: str, arm: str, progress: Progress) -> None:
        phase, shown_s = self._shown.get(arm, ("", -math.inf))
        if not progress.phase or (progress.phase == phase and now - shown_s < LINE_PERIOD):
            return
        self._shown[arm] = (progress.phase, now)
        values = "  ".join(f"{name} {value}" for name, value in figures(progress).items())
        self.say(f"  {label}  {arm}  {progress.phase:<12}{100 * progress.fraction:4.0f} %  {values}")


def figures(progress: Progress) -> dict[str, str]:
    """The numbers worth watching, with units."""
    return {
        "path": f"{progress.travelled * MM:6.1f} mm",
        "depth": _number(progress.depth * MM, "5.2f", "mm"),
        "normal error": _number(progress.normal_error * DEGREES, "4.1f", "deg"),
        "latency": _number(progress.latency * MS, "5.1f", "ms"),
    }


def _panel(arms: Mapping[str, tuple[str, Progress]]) -> Group:
    rows: list[RenderableType] = []
    for arm, (label, progress) in arms.items():
        bar = Table.grid(padding=(0, 2))
        bar.add_row(Text(f"{label}  {arm}", "bold"), Text(progress.phase or "waiting", "cyan"))
        bar.add_row(
            ProgressBar(total=1.0, completed=progress.fraction, width=40), f"{progress.fraction:4.0%}"
        )
        values = Table.grid(padding=(0, 2))
        values.add_row(*(Text.assemble((f"{n} ", "dim"), v) for n, v in figures(progress).items()))
        rows += [bar, values]
        if progress.reason:
            rows.append(Text(progress.reason, "yellow"))
    return Group(*rows)


def _number(value: float, form: str, unit: str) -> str:
    return f"{'-':>5} {unit}" if math.isnan(value) else f"{value:{form}} {unit}"
