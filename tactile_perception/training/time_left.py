"""How long a training run will still take."""

from __future__ import annotations

from collections import deque


class TimeLeft:
    """Estimates from the steps and validations so far; early stopping may end a run sooner.

    Steps are averaged over the last epoch, so that the estimate follows a machine that others use as well,
    without following every hiccup.
    """

    #: Cost of a validation image as part of a training image, until one validation has been measured.
    _VALIDATION_COST = 0.3

    def __init__(self, epochs: int, steps: int, batch_size: int, validation_samples: int) -> None:
        self._epochs, self._steps = epochs, steps
        self._recent: deque[float] = deque(maxlen=steps)
        self._validation: float | None = None
        self._validation_batches = validation_samples / batch_size

    def step(self, seconds: float) -> None:
        """One training step took so long."""
        self._recent.append(seconds)

    def validation(self, seconds: float) -> None:
        """One validation, with writing of the run's files, took so long."""
        self._validation = seconds

    def seconds(self, epochs_done: int, steps_done: int = 0) -> float | None:
        """Seconds left after so many whole epochs and steps of the next; None before the first step."""
        if not self._recent:
            return None
        step = sum(self._recent) / len(self._recent)
        epochs = self._epochs - epochs_done
        validation = self._validation
        if validation is None:
            validation = self._VALIDATION_COST * step * self._validation_batches
        return (epochs * self._steps - steps_done) * step + epochs * validation
