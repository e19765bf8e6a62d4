"""What a training run reports while it goes on, how it is shown, and how long the run will still take."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from tactile_base.progress import Progress, duration
from tactile_perception.estimating.contact_model import SURFACE, ContactModel
from tactile_perception.estimating.labels import errors_in_words
from tactile_perception.training.run_folder import Epoch


class TrainingProgress:
    """Gets every report of a run and shows none; `TrainingDisplay` shows them."""

    def loading(self, done: int, total: int) -> None:
        """Images read so far."""

    def following(self, done: int, total: int) -> None:
        """Images so far whose markers were followed."""

    def learning(self, model: ContactModel) -> None:
        """What the network is to tell, and what of it is labelled."""

    def start(self, epochs: int, steps: int, loss_name: str, epochs_done: int) -> None:
        """Data are in memory; `epochs_done` is not 0 where a run is resumed."""

    def step(self, epoch: int, step: int, loss: float, seconds_left: float | None) -> None:
        """A step is done; `loss` is the mean over the epoch so far."""

    def epoch(self, epoch: Epoch) -> None:
        """An epoch and its validation are done."""


class TrainingDisplay(Progress, TrainingProgress):
    """A bar with epoch, loss and time left on a terminal, and a line for each epoch; use as a context."""

    def __init__(self) -> None:
        super().__init__(line_period=math.inf)  # there is a line for each epoch
        self._steps = self._epochs = 0
        self._loss_name = ""
        self._announced = False
        self._model = SURFACE

    def learning(self, model: ContactModel) -> None:
        self.finish("loading")
        self.finish("following markers")
        self._model = model
        if model.unknown:
            self.say(model.says_unknown())

    def loading(self, done: int, total: int) -> None:
        self.update("loading", done, total, "images")

    def following(self, done: int, total: int) -> None:
        self.finish("loading")
        self.update("following markers", done, total, "images")

    def start(self, epochs: int, steps: int, loss_name: str, epochs_done: int) -> None:
        self._steps, self._epochs, self._loss_name = steps, epochs, loss_name
        if epochs_done:
            self.say(f"resumed after epoch {epochs_done} of {epochs}")

    def step(self, epoch: int, step: int, loss: float, seconds_left: float | None) -> None:
        if seconds_left is not None and not self._announced:
            self._announced = True
            self.say(f"{self._epochs - epoch} epochs will take about {duration(seconds_left)}")
        done, total = epoch * self._steps + step + 1, self._epochs * self._steps
        text = f"epoch {epoch + 1}, {self._loss_name} {loss:.3f}"
        left = math.nan if seconds_left is None else seconds_left
        self.update("training", done, total, text=text, seconds_left=left)

    def epoch(self, epoch: Epoch) -> None:
        self._announced, model = True, self._model  # by this line
        units = dict(zip(model.names, model.units, strict=True))
        self.say(
            f"epoch {epoch.number + 1:3d}  lr {epoch.learning_rate:.1e}  {self._loss_name} "
            f"train {epoch.train_loss:7.3f} val {epoch.validation_loss:7.3f}  "
            f"val MAE {errors_in_words(dict(zip(model.names, epoch.mae, strict=True)), units)}  "
            f"{epoch.seconds:.0f} s, {duration(epoch.seconds_left)} left{'  best' if epoch.best else ''}"
        )


class TimeLeft:
    """Estimates from the steps and validations so far; early stopping may end a run sooner.

    What counts is the last epoch's steps, so that the estimate follows a machine that others use as well: the
    median over a few stretches of them of each stretch's mean, which a pause of some seconds does not move
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
