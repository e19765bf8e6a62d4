"""How long a training run will still take."""

from __future__ import annotations

from collections import deque

import numpy as np


class TimeLeft:
    """Estimates from the steps and validations so far; early stopping may end a run sooner.

    What counts is the last epoch's steps, so that the estimate follows a machine that others use as well: the
    median over a few stretches of them of each stretch's mean, which a hiccup of some seconds does not move
    and one that comes again and again does. In the first epoch only the later half of the steps counts, since
    the first ones warm up caches and memory, and nothing is said before there is enough of them.
    """

    #: Cost of a validation image as part of a training image, until one validation has been measured.
    _VALIDATION_COST = 0.3
    #: What has to be measured before the first estimate, unless the first epoch ends sooner.
    _FIRST_STEPS, _FIRST_SECONDS = 20, 20.0
    _STRETCHES = 5

    def __init__(self, epochs: int, steps: int, batch_size: int, validation_samples: int) -> None:
        self._epochs, self._steps = epochs, steps
        self._recent: deque[float] = deque(maxlen=steps)
        self._measured = 0.0
        self._validation: float | None = None
        self._validation_batches = validation_samples / batch_size

    def step(self, seconds: float) -> None:
        """One training step took so long."""
        self._recent.append(seconds)
        self._measured += seconds

    def validation(self, seconds: float) -> None:
        """One validation took so long."""
        self._validation = seconds

    def seconds(self, epochs_done: int, steps_done: int = 0) -> float | None:
        """Seconds left after so many whole epochs and steps of the next; None while too little is known."""
        if self._validation is None:
            if len(self._recent) < self._FIRST_STEPS or self._measured < self._FIRST_SECONDS:
                return None
            step = self._typical(len(self._recent) // 2)
            validation = self._VALIDATION_COST * step * self._validation_batches
        else:
            step, validation = self._typical(), self._validation
        epochs = self._epochs - epochs_done
        return (epochs * self._steps - steps_done) * step + epochs * validation

    def _typical(self, skipped: int = 0) -> float:
        """Seconds a step takes, without the first `skipped` of the recent ones."""
        steps = np.array(self._recent)[skipped:]
        stretches = np.array_split(steps, min(self._STRETCHES, len(steps)))
        return float(np.median([stretch.mean() for stretch in stretches]))
