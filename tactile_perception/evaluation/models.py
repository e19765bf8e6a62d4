"""Trained networks as an evaluation takes them: run folders or ONNX files, run on many images at once."""

from __future__ import annotations

import dataclasses
import os
import string
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_perception.estimating.estimator import Estimator, ModelError
from tactile_perception.estimating.model_metadata import MODEL_NAME, ModelMetadata
from tactile_perception.estimating.preprocessing import as_input
from tactile_perception.evaluation.metrics import Predictions

#: What the heads that `tactile train` knows are called in tables.
KINDS = {
    "mse": "CNN",
    "gaussian": "GDN",
    "full_gaussian": "GDN with full covariance",
    "mixture": "GDN of two Gaussians",
    "ensemble": "ensemble",
}
_BATCH = 50
#: What makes two models different kinds; the rest of a model's facts is a result of its training.
_SECTIONS = ("network", "training", "augmentation")
#: Settings in which models of one group may differ: chance, and what concerns speed only.
_WITHOUT_EFFECT = ("training.seed", "training.threads", "training.max_minutes", "training.precision")
#: More differences than these do not fit over a column.
_MOST_NAMED = 2


@dataclass(frozen=True)
class Model:
    """One trained network.

    Attributes
    ----------
    name : for tables and files, different for each model of an evaluation
    kind : which network it is; models of one kind differ by chance only and share a column of the tables
    """

    name: str
    kind: str
    estimator: Estimator

    @property
    def metadata(self) -> ModelMetadata:
        """What the model file says about itself."""
        return self.estimator.metadata

    @property
    def has_uncertainty(self) -> bool:
        """Whether it says of each image how wrong it may be."""
        return self.metadata.head != "mse"

    def predict(
        self, images: NDArray[np.uint8], progress: Callable[[int], None] | None = None
    ) -> Predictions:
        """Predictions for pre-processed images, uint8 (N, size, size), as the network gives them.

        Raises `ModelError` if an answer is not finite, or has no positive definite covariance.
        """
        mean, cov = predict_all(self.estimator, images, progress)
        self._check(mean, "mu")
        self._check(cov.reshape(len(cov), -1), "covariance")
        self._check(np.linalg.eigvalsh(cov), "eigenvalues of the covariance", positive=True)
        return Predictions(mean, cov if self.has_uncertainty else None)

    def _check(self, array: NDArray[Any], what: str, positive: bool = False) -> None:
        usable = np.isfinite(array) & (array > 0.0) if positive else np.isfinite(array)
        wrong = np.flatnonzero(~usable.all(axis=1))
        if len(wrong):
            raise ModelError(
                f"{self.estimator.path}: {what} = {array[wrong[0]]} for image {wrong[0]} "
                f"({len(wrong)} such images); must be finite{' and positive' if positive else ''}"
            )


def predict_all(
    estimator: Estimator, images: NDArray[np.uint8], progress: Callable[[int], None] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`Estimator.predict_uncalibrated` for any number of pre-processed images, some at a time."""
    parts = []
    for start in range(0, len(images), _BATCH):
        batch = as_input(images[start : start + _BATCH])
        parts.append(estimator.predict_uncalibrated(batch))
        if progress is not None:
            progress(len(batch))
    mean, cov = (np.concatenate(column) for column in zip(*parts, strict=True))
    return mean, cov


def open_models(runs: Sequence[Path | str], threads: int = 0) -> list[Model]:
    """Models of run folders (of `tactile train`), of folders of such folders, or of ONNX files.

    An inference takes so many CPU `threads`, or 0 for as many as there are cores. `ModelError` names the file
    or folder, what is wrong and what would be right.
    """
    paths = [path for run in runs for path in _model_paths(Path(run))]
    opened = [Estimator(path, threads or os.cpu_count() or 1) for path in paths]
    kinds = [KINDS.get(estimator.metadata.head, estimator.metadata.head) for estimator in opened]
    return _with_kinds([Model(*parts) for parts in zip(_names(paths), kinds, opened, strict=True)])


def _with_kinds(models: list[Model]) -> list[Model]:
    """Models of one head but other settings are different kinds, named after what differs, or A, B, C."""
    found = []
    for model in models:
        settings = [_compared_settings(other) for other in models if other.kind == model.kind]
        mine = _compared_settings(model)
        differing = [key for key in mine if any(other.get(key, mine[key]) != mine[key] for other in settings)]
        distinct = list(dict.fromkeys(tuple(other.get(key) for key in differing) for other in settings))
        label = ", ".join(f"{key.split('.')[-1]} {mine[key]}" for key in differing)
        if len(differing) > _MOST_NAMED:
            label = string.ascii_uppercase[distinct.index(tuple(mine[key] for key in differing)) % 26]
        found.append(dataclasses.replace(model, kind=f"{model.kind} ({label})" if label else model.kind))
    return found


def _compared_settings(model: Model) -> dict[str, str]:
    """Every setting of network and training that is the same for models of one kind, as text."""
    return {
        f"{section}.{name}": str(value)
        for section in _SECTIONS
        for name, value in model.metadata.training.get(section, {}).items()
        if f"{section}.{name}" not in _WITHOUT_EFFECT
    }


def _model_paths(run: Path) -> list[Path]:
    if run.is_file():
        return [run]
    if not run.is_dir():
        raise ModelError(f"{run}: there is no such run folder or model file")
    if (run / MODEL_NAME).is_file():
        return [run / MODEL_NAME]
    repeated = sorted(run.glob(f"*/{MODEL_NAME}"))
    if not repeated:
        raise ModelError(
            f"{run}: holds no {MODEL_NAME}, nor do its subfolders: a run that has not ended has none yet"
        )
    return repeated


def _names(paths: Sequence[Path]) -> list[str]:
    """Short names that tell the models apart: of the run's folder, else of the file, else the whole path."""
    short = [path.parent.name if path.name == MODEL_NAME else path.stem for path in map(Path.absolute, paths)]
    return [name if short.count(name) == 1 else str(path) for name, path in zip(short, paths, strict=True)]
