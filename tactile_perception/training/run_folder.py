"""The folder of a training run: configuration, table and curves of the epochs, state, result."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from numpy.typing import NDArray

from tactile_base.input_file import check_regular, parse_json, read_text
from tactile_base.whole_file import check_folder, whole_file, write_csv
from tactile_base.yaml_file import values_of
from tactile_perception.estimating.contact_model import ContactModel
from tactile_perception.estimating.model_metadata import RESULT_NAME
from tactile_perception.training.config import TrainConfig

CONFIG_NAME = "config.yaml"
DATA_NAME = "data.txt"
FACTS_NAME = "data.json"
EPOCHS_NAME = "epochs.csv"
CURVES_NAME = "curves.png"
BEST_NAME = "best.pt"
STATE_NAME = "state.pt"
#: Settings that may change when a run is resumed; what a start is, the facts about the data tell.
_NO_RESULT = {"threads", "max_minutes", "start", "precision"}


@dataclass(frozen=True)
class Epoch:
    """Result of one epoch; `mae` (K,) in mm, rad and N on the validation data, NaN where nothing is labelled.

    `seconds_left` is what the rest of the schedule was then expected to take.
    """

    number: int
    learning_rate: float
    train_loss: float
    validation_loss: float
    mae: NDArray[np.float64]
    seconds: float
    best: bool
    seconds_left: float = 0.0


@dataclass(frozen=True)
class TrainResult:
    """Result of a run: the best epoch's model and what became of each epoch."""

    model_path: Path
    best: Epoch
    epochs: list[Epoch]
    stopped: str
    minutes: float


class RunFolder:
    """Reads and writes the files of one run. Each is whole at any moment: a kill loses at most an epoch."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)

    def file(self, name: str) -> Path:
        return self.path / name

    @property
    def finished(self) -> bool:
        return self.file(RESULT_NAME).exists()

    def check_free(self) -> None:
        """`OSError` if there can be no run here: there is a finished one, or no folder to write to."""
        if self.finished:
            raise FileExistsError(f"{self.path}: holds another run; remove it or choose another folder")
        check_folder(self.path)

    def open(self, config: TrainConfig, data: dict[str, Any], report: list[str]) -> bool:
        """Make the folder, or find in it a run of the same configuration and data; True: it can be resumed.

        `data` are the facts that have to agree, `report` what else was found in the data folders.

        Raises `FileExistsError` if it holds a finished run, or one that was started differently.
        """
        self.check_free()
        self.path.mkdir(parents=True, exist_ok=True)
        resumed = self.file(CONFIG_NAME).exists() and self.file(STATE_NAME).exists()
        if self.file(CONFIG_NAME).exists():
            self.check_same(config, data)
        else:
            _write(self.file(FACTS_NAME), json.dumps(data, indent=2) + "\n")
        _write(self.file(CONFIG_NAME), yaml.safe_dump(config.plain(), sort_keys=False))
        _write(self.file(DATA_NAME), "\n".join(report) + "\n")
        return resumed

    def check_same(self, config: TrainConfig, data: dict[str, Any] | None = None) -> None:
        """`FileExistsError` unless the run here was started with this configuration (and these data).

        The calibration is fitted when training has ended, so its settings may be others.
        """
        wanted, difference = config.plain(), "an unreadable configuration"
        with contextlib.suppress(ValueError):
            found = values_of(read_text(self.file(CONFIG_NAME)), CONFIG_NAME)
            found["calibration"] = wanted["calibration"]
            if data is not None:
                found["data"], wanted["data"] = parse_json(read_text(self.file(FACTS_NAME))), data
            difference = _difference(found, wanted)
        if difference:
            raise FileExistsError(
                f"{self.path}: holds another run that was started with {difference}; "
                "remove it, choose another folder, or ask for the same to resume it"
            )

    def save_state(self, state: dict[str, Any]) -> None:
        """Keep what a resumed run needs."""
        _save(self.file(STATE_NAME), state)

    def load_state(self) -> dict[str, Any]:
        return _load(self.file(STATE_NAME))

    def save_best(self, weights: dict[str, torch.Tensor]) -> None:
        _save(self.file(BEST_NAME), weights)

    def load_best(self) -> dict[str, torch.Tensor]:
        return _load(self.file(BEST_NAME))

    def write_epochs(self, epochs: list[Epoch], loss_name: str, columns: Sequence[str]) -> None:
        """`epochs.csv`: one line an epoch, with the errors of these columns."""
        loss, mae = loss_name.replace(" ", "_"), [f"mae_{column}" for column in columns]
        head = ["epoch", "learning_rate", f"train_{loss}", f"validation_{loss}", *mae]
        rows = []
        for epoch in epochs:
            values = [epoch.learning_rate, epoch.train_loss, epoch.validation_loss, *epoch.mae]
            values += [epoch.seconds, epoch.seconds_left]
            rows.append([epoch.number + 1, *(f"{value:.6g}" for value in values)])
        write_csv(self.file(EPOCHS_NAME), [*head, "seconds", "seconds_left"], rows)

    def finish(
        self, result: TrainResult, loss_name: str, validation: dict[str, Any], model: ContactModel
    ) -> None:
        """Curves and `result.json`, whose presence says that the run is complete."""
        draw_curves(self.file(CURVES_NAME), result.epochs, loss_name, model)
        values = {
            "best_epoch": result.best.number + 1,
            "epochs": len(result.epochs),
            "loss": loss_name,
            **validation,
            "units": dict(zip(model.names, model.units, strict=True)),
            "not_labelled": list(model.unknown),
            "stopped": result.stopped,
            "minutes": result.minutes,
        }
        _write(self.file(RESULT_NAME), json.dumps(values, indent=2) + "\n")
        self.file(STATE_NAME).unlink(missing_ok=True)

    def finish_folds(self, runs: Sequence[Path], mae: NDArray[np.float64]) -> None:
        """`result.json` of networks that are joined: their mean errors (K,) on what each held back."""
        results = [RunFolder(run).result() for run in runs]
        units = results[0]["units"]
        values = {
            "folds": len(runs),
            "mae": {name: value for name, value in zip(units, mae.tolist(), strict=True) if value == value},
            "units": units,
            "not_labelled": results[0]["not_labelled"],
            "minutes": sum(result["minutes"] for result in results),
        }
        _write(self.file(RESULT_NAME), json.dumps(values, indent=2) + "\n")

    def result(self) -> dict[str, Any]:
        """`result.json` of a finished run."""
        values: dict[str, Any] = parse_json(read_text(self.file(RESULT_NAME)))
        return values


def _difference(found: dict[str, Any], wanted: dict[str, dict[str, Any]]) -> str:
    """The first value that differs, in words; empty if none does."""
    for section, values in wanted.items():
        part = found.get(section)
        old = part if isinstance(part, dict) else {}
        for name in sorted({*old, *values} - _NO_RESULT):
            if old.get(name) != values.get(name):
                return f"{section}.{name} = {old.get(name)}, not {values.get(name)}"
    return ""


def _save(path: Path, value: Any) -> None:
    buffer = io.BytesIO()  # what torch raises where a disk is full says nothing of it
    torch.save(value, buffer)
    with whole_file(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def _load(path: Path) -> dict[str, Any]:
    """Plain values and tensors: nothing in the file is run."""
    check_regular(path)
    try:
        values: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # what a damaged file raises has no base class of its own
        first = str(error).partition("\n")[0]
        raise ValueError(
            f"{path}: cannot be read ({first}); remove {path.parent} to train from the start"
        ) from error
    return values


def _write(path: Path, text: str) -> None:
    with whole_file(path) as temporary:
        temporary.write_text(text)


def draw_curves(path: Path, epochs: list[Epoch], loss_name: str, model: ContactModel) -> None:
    """Loss and MAE over the epochs."""
    from tactile_perception.estimating.plots import log_axis, plot_grid

    units = list(dict.fromkeys(model.units))
    figure, [[loss, *errors]] = plot_grid(1, 1 + len(units), 3.3)
    number = [epoch.number + 1 for epoch in epochs]
    loss.plot(number, [epoch.train_loss for epoch in epochs], label="training (with dropout)")
    loss.plot(number, [epoch.validation_loss for epoch in epochs], label="validation")
    loss.set(xlabel="epoch", ylabel=loss_name)
    mae = np.array([epoch.mae for epoch in epochs])
    for component, (name, unit) in enumerate(zip(model.names, model.units, strict=True)):
        if np.isfinite(mae[:, component]).any():
            errors[units.index(unit)].plot(number, mae[:, component], label=name)
    for axes, unit in zip(errors, units, strict=True):
        axes.set(xlabel="epoch", ylabel=f"validation MAE ({unit})")
        log_axis(axes, "y")
    for axes in (loss, *errors):
        axes.legend()
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
