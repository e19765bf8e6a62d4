"""Progress of a training run on the terminal: epoch, loss, time left, and a line for each epoch."""

from __future__ import annotations

from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars

from tactile_perception.training.progress import Progress
from tactile_perception.training.run_folder import Epoch


class TrainingProgress(Progress):
    """Shows a run; use as a context. Without a terminal it prints one line an epoch."""

    def __init__(self) -> None:
        self.console = Console(stderr=True)
        self._bars = Bars(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal,
        )
        self._loading = self._bars.add_task("loading", total=None, text="", left="")
        self._steps = self._epochs = 0
        self._loss_name = ""
        self._announced = False
        self._run: TaskID | None = None

    def __enter__(self) -> TrainingProgress:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def loading(self, done: int, total: int) -> None:
        self._bars.update(self._loading, completed=done, total=total, text=f"{done}/{total} images")

    def start(self, epochs: int, steps: int, loss_name: str, epochs_done: int) -> None:
        self._bars.update(self._loading, visible=False)
        self._steps, self._epochs, self._loss_name = steps, epochs, loss_name
        self._run = self._bars.add_task(
            "training", total=epochs * steps, completed=epochs_done * steps, text="", left=""
        )
        if epochs_done:
            self.console.print(f"resumed after epoch {epochs_done} of {epochs}", highlight=False)

    def step(self, epoch: int, step: int, loss: float, seconds_left: float | None) -> None:
        if seconds_left is not None and not self._announced:
            self._announced = True
            left = duration(seconds_left)
            self.console.print(f"{self._epochs - epoch} epochs will take about {left}", highlight=False)
        if self._run is not None:
            text = f"epoch {epoch + 1}, {self._loss_name} {loss:.3f}"
            left = "" if seconds_left is None else f"{duration(seconds_left)} left"
            self._bars.update(self._run, completed=epoch * self._steps + step + 1, text=text, left=left)

    def epoch(self, epoch: Epoch) -> None:
        self._announced = True  # by this line
        mae = " ".join(f"{value:.4f}" for value in epoch.mae)
        mark = "  best" if epoch.best else ""
        self.console.print(
            f"epoch {epoch.number + 1:3d}  lr {epoch.learning_rate:.1e}  {self._loss_name} "
            f"train {epoch.train_loss:7.3f} val {epoch.validation_loss:7.3f}  MAE {mae}  "
            f"{epoch.seconds:.0f} s, {duration(epoch.seconds_left)} left{mark}",
            highlight=False,
            soft_wrap=True,
        )


def duration(seconds: float) -> str:
    """Seconds as a person says them."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    if seconds < 5400.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h"
