"""Progress of a training run on the terminal: epoch, loss, time left, and a line for each epoch."""

from __future__ import annotations

from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from tactile_perception.training.train import Epoch, Progress


class TrainingProgress(Progress):
    """Shows a run; use as a context. Without a terminal it prints one line an epoch."""

    def __init__(self) -> None:
        self.console = Console(stderr=True)
        self._bars = Bars(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            # The estimate averages over ten minutes of steps: epochs, not steps, have a steady pace.
            TimeRemainingColumn(),
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal,
            speed_estimate_period=600.0,
        )
        self._loading = self._bars.add_task("loading", total=None, text="")
        self._steps = 0
        self._run: TaskID | None = None

    def __enter__(self) -> TrainingProgress:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def loading(self, done: int, total: int) -> None:
        self._bars.update(self._loading, completed=done, total=total, text=f"{done}/{total} images")

    def start(self, epochs: int, steps: int) -> None:
        self._bars.remove_task(self._loading)
        self._steps = steps
        self._run = self._bars.add_task("training", total=epochs * steps, text="")

    def step(self, epoch: int, step: int, loss: float) -> None:
        if self._run is not None:
            text = f"epoch {epoch + 1}, mean NLL {loss:.3f}"
            self._bars.update(self._run, completed=epoch * self._steps + step + 1, text=text)

    def epoch(self, epoch: Epoch) -> None:
        mae = " ".join(f"{value:.4f}" for value in epoch.mae)
        mark = "  best" if epoch.best else ""
        self.console.print(
            f"epoch {epoch.number + 1:3d}  lr {epoch.learning_rate:.1e}  NLL train {epoch.train_loss:7.3f} "
            f"val {epoch.validation_loss:7.3f}  MAE {mae}  {epoch.seconds:.0f} s{mark}",
            highlight=False,
        )
