"""Trained networks as an evaluation takes them: run folders or ONNX files, run on many images at once."""

from __future__ import annotations

import dataclasses
import os
import string
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from tactile_perception.estimator import ModelError
from tactile_perception.evaluation.predictions import Predictions
from tactile_perception.model_metadata import INPUT_NAME, MetadataError, ModelMetadata
from tactile_perception.preprocessing import as_input

MODEL_NAME = "model.onnx"
#: What the heads that `tactile train` knows are called in tables.
KINDS = {
    "mse": "CNN",
    "gaussian": "GDN",
    "full_gaussian": "GDN with full covariance",
    "mixture": "GDN of two Gaussians",
}
_BATCH = 50
_MEAN, _INVERSE_SIGMA, _COVARIANCE = "mu", "inverse_sigma", "covariance"
#: Settings in which models of one group may differ: chance, and what concerns speed only.
_NOT_TOLD = ("training.seed", "training.threads", "training.max_minutes", "training.precision")
#: More differences than these do not fit over a column.
_MOST_TOLD = 2


@dataclass(frozen=True)
class Model:
    """One trained network.

    Attributes
    ----------
    name : for tables and files, different for each model of an evaluation
    kind : which network it is; models of one kind differ by chance only and share a column of the tables
    """

    name: str
    path: Path
    kind: str
    metadata: ModelMetadata
    session: onnxruntime.InferenceSession

    @property
    def outputs(self) -> list[str]:
        """Names of what it gives: the mean and, if it has any, its uncertainty."""
        names = [output.name for output in self.session.get_outputs()]
        return [name for name in (_MEAN, _INVERSE_SIGMA, _COVARIANCE) if name in names]

    @property
    def has_uncertainty(self) -> bool:
        """Whether it says how wrong it may be."""
        return len(self.outputs) > 1

    def predict(
        self, images: NDArray[np.uint8], progress: Callable[[int], None] | None = None
    ) -> Predictions:
        """Predictions for pre-processed images, uint8 (N, size, size), as the network gives them.

        Raises
        ------
        ModelError
            If an answer is not finite, or has no positive standard deviations.
        """
        parts: list[list[NDArray[np.float32]]] = []
        for start in range(0, len(images), _BATCH):
            batch = as_input(images[start : start + _BATCH])
            parts.append(self.session.run(self.outputs, {INPUT_NAME: batch}))
            if progress is not None:
                progress(len(batch))
        columns = [np.concatenate(column).astype(np.float64) for column in zip(*parts, strict=True)]
        answers = dict(zip(self.outputs, columns, strict=True))
        if _INVERSE_SIGMA in answers:
            self._check(answers[_INVERSE_SIGMA], _INVERSE_SIGMA, positive=True)
            predictions = Predictions.from_inverse_sigma(answers[_MEAN], answers[_INVERSE_SIGMA])
        else:
            predictions = Predictions(answers[_MEAN], answers.get(_COVARIANCE))
        self._check(predictions.mean, _MEAN)
        if predictions.cov is not None:
            eigenvalues = np.linalg.eigvalsh(predictions.cov).astype(np.float64)
            self._check(eigenvalues, "eigenvalues of the covariance", positive=True)
        return predictions

    def _check(self, array: NDArray[np.float64], what: str, positive: bool = False) -> None:
        usable = np.isfinite(array) & (array > 0.0) if positive else np.isfinite(array)
        wrong = np.flatnonzero(~usable.all(axis=1))
        if len(wrong):
            raise ModelError(
                f"{self.path}: {what} = {array[wrong[0]]} for image {wrong[0]} ({len(wrong)} such images); "
                f"must be finite{' and positive' if positive else ''}"
            )


def open_models(runs: Sequence[Path | str], threads: int = 0) -> list[Model]:
    """Models of run folders (of `tactile train`), of folders of such folders, or of ONNX files.

    Parameters
    ----------
    threads : int
        CPU threads of an inference; 0: as many as there are cores.

    Raises
    ------
    ModelError
        Naming the file or folder, what is wrong and what would be right.
    """
    paths = [path for run in runs for path in _model_paths(Path(run))]
    names = _names(paths)
    return _with_kinds([_open(path, name, threads) for path, name in zip(paths, names, strict=True)])


def _with_kinds(models: list[Model]) -> list[Model]:
    """Models of one head but other settings are different kinds, named after what differs, or A, B, C."""
    found = []
    for model in models:
        settings = [_told_settings(other) for other in models if other.kind == model.kind]
        mine = _told_settings(model)
        differing = [key for key in mine if any(other.get(key, mine[key]) != mine[key] for other in settings)]
        distinct = list(dict.fromkeys(tuple(other.get(key) for key in differing) for other in settings))
        label = ", ".join(f"{key.split('.')[-1]} {mine[key]}" for key in differing)
        if len(differing) > _MOST_TOLD:
            label = string.ascii_uppercase[distinct.index(tuple(mine[key] for key in differing)) % 26]
        found.append(dataclasses.replace(model, kind=f"{model.kind} ({label})" if label else model.kind))
    return found


def _told_settings(model: Model) -> dict[str, str]:
    """Every setting of network and training in which models of one kind agree, as text."""
    return {
        f"{section}.{name}": str(value)
        for section, values in model.metadata.training.items()
        if isinstance(values, dict)
        for name, value in values.items()
        if f"{section}.{name}" not in _NOT_TOLD
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


def _open(path: Path, name: str, threads: int) -> Model:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or os.cpu_count() or 1
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions share no base class of their own
        raise ModelError(f"{path}: is not a usable ONNX model: {error}") from error
    try:
        metadata = ModelMetadata.from_properties(session.get_modelmeta().custom_metadata_map)
    except MetadataError as error:
        raise ModelError(f"{path}: {error}") from error
    names = [output.name for output in session.get_outputs()]
    if _MEAN not in names:
        raise ModelError(f"{path}: has the outputs {', '.join(names)}; must have {_MEAN}")
    head = metadata.training.get("network", {}).get("head", "gaussian" if len(names) > 1 else "mse")
    return Model(name, path, KINDS.get(head, head), metadata, session)
