"""What `tactile launch`, `run` and `data collect` show while they work, on the `Progress` of all commands."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.console import Console

from tactile_base import progress as base
from tactile_base.keys import Keys
from tactile_base.progress import Progress
from tactile_control.phases import GO_TO_START
from tactile_records.collecting.settings import REFERENCE, TOUCH

if TYPE_CHECKING:
    from tactile_bringup.launching.task_client import Progress as TaskProgress

KEYS = "space stops all arms at once; Ctrl-C ends the task and brings them to rest"
STOP_KEYS = frozenset(" s\x1b")  # Escape, too, with which other keys begin
LINE_PERIOD = 2.0  # s between plain lines of one phase
MM, DEGREES, MS = 1e3, 180.0 / math.pi, 1e3
#: Phases before the first sample, which say nothing of the pace.
BEFORE_SAMPLES = (GO_TO_START, REFERENCE, TOUCH)


class Display(Progress):
    """Shows headlines and how far each arm is with its goal, which is given by a label."""

    def __init__(self, console: Console, live: bool, line_period: float = LINE_PERIOD) -> None:
        super().__init__(console, live, line_period)
        self._keys = Keys()

    def __enter__(self) -> Display:
        self._keys.__enter__()
        if self._keys.there:
            self.say(KEYS)
        super().__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        super().__exit__(*exception)
        self._keys.__exit__(*exception)

    def stop_wanted(self) -> bool:
        """Whether a key that stops all arms was pressed since the last look."""
        return not STOP_KEYS.isdisjoint(self._keys.pressed())

    def show(self, arm: str, label: str, progress: TaskProgress, ends: bool = True) -> None:
        """Show how far an arm is with the goal of that label; nobody knows of one that never `ends`."""
        if progress.phase:
            path = f"path {progress.travelled * MM:.1f} mm"
            text = ", ".join(part for part in (progress.reason, path, *_figures(progress)) if part)
            name, state = _name(arm, label), progress.phase
            done, total = (progress.fraction, 1.0) if ends else (0.0, None)
            self.update(name, done, total, state=state, text=text, seconds_left=math.nan)

    def conclude(self, arm: str, label: str) -> None:
        """The arm's goal of that label has ended."""
        self.finish(_name(arm, label))


class CollectionDisplay(Display):
    """Shows how far a collection is; `samples` is the number that the folder is to hold."""

    def __init__(self, console: Console, live: bool, samples: int) -> None:
        super().__init__(console, live, base.LINE_PERIOD)
        self._samples = samples

    def show(self, arm: str, label: str, progress: TaskProgress, ends: bool = True) -> None:
        """Show the collection of an arm; each sample has all phases, so these are no lines of their own."""
        if not progress.phase:
            return
        done = round(progress.fraction * self._samples)
        depth = "" if math.isnan(progress.depth) else f"depth {progress.depth * MM:5.2f} mm"
        text = ", ".join(part for part in (progress.phase, depth, progress.reason) if part)
        total = None if progress.phase in BEFORE_SAMPLES else self._samples
        self.update(arm, done, total, "samples", text=text)


def _name(arm: str, label: str) -> str:
    return f"{label} {arm}"


def _figures(progress: TaskProgress) -> list[str]:
    known = (
        ("depth", progress.depth * MM, ".2f", "mm"),
        ("normal error", progress.normal_error * DEGREES, ".1f", "deg"),
        ("latency", progress.latency * MS, ".1f", "ms"),
    )
    return [f"{name} {value:{form}} {unit}" for name, value, form, unit in known if not math.isnan(value)]
