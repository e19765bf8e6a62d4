"""What a training run tells while it goes on."""

from __future__ import annotations

from tactile_perception.training.run_folder import Epoch


class Progress:
    """Told of everything and says nothing; `console.TrainingProgress` shows it."""

    def loading(self, done: int, total: int) -> None:
        """Images read so far."""

    def start(self, epochs: int, steps: int, loss_name: str, epochs_done: int) -> None:
        """Data are in memory; `epochs_done` is not 0 where a run is resumed."""

    def step(self, epoch: int, step: int, loss: float, seconds_left: float | None) -> None:
        """A step is done; `loss` is the mean over the epoch so far."""

    def epoch(self, epoch: Epoch) -> None:
        """An epoch and its validation are done."""
