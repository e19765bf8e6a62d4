"""What `tactile data collect` shows while it works: samples, pace and the time left."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from rich.console import Console

from tactile_base.progress import Progress
from tactile_bringup.launching.progress import MM, Display
from tactile_control.collection import REFERENCE, TOUCH
from tactile_control.phases import GO_TO_START

if TYPE_CHECKING:
    from tactile_bringup.launching.task_client import Progress as TaskProgress

#: Phases before the first sample, which say nothing of the pace.
BEFORE_SAMPLES = (GO_TO_START, REFERENCE, TOUCH)


class CollectionDisplay(Display):
    """Shows how far the collection is.

    Parameters
    ----------
    samples : int
        That the folder is to hold.
    """

    def __init__(self, console: Console, live: bool, samples: int) -> None:
        self._progress, self._samples = Progress(console, live), samples

    def __enter__(self) -> CollectionDisplay:
        self._progress.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        self._progress.__exit__(*exception)

    def say(self, text: str, style: str | None = None) -> None:
        """A line that stays."""
        self._progress.say(text, style)

    def update(self, arms: Mapping[str, tuple[str, TaskProgress]]) -> None:
        """Show the collection of each arm; each sample has all phases, so these are no lines of their own."""
        for arm, (_, progress) in arms.items():
            if not progress.phase:
                continue
            done = round(progress.fraction * self._samples)
            depth = "" if math.isnan(progress.depth) else f"depth {progress.depth * MM:5.2f} mm"
            text = ", ".join(part for part in (progress.phase, depth, progress.reason) if part)
            total = None if progress.phase in BEFORE_SAMPLES else self._samples
            self._progress.update(arm, done, total, "samples", text=text)
