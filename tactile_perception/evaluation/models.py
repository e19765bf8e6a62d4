"""Trained networks as an evaluation takes them: run folders or ONNX files, run on many images at once."""

from __future__ import annotations

import os
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
_BATCH = 50
_MEAN, _INVERSE_SIGMA = "mu", "inverse_sigma"


@dataclass(frozen=True)
class Model:
    """One trained network.

    Attributes
    ----------
    name : for tables and files, different for each model of an evaluation
    kind : "CNN" for a network without uncertainty, "GDN" for one with a diagonal covariance
    """

    name: str
    path: Path
    kind: str
    metadata: ModelMetadata
    session: onnxruntime.InferenceSession

    @property
    def has_uncertainty(self) -> bool:
        """Whether it says how wrong it may be."""
        return self.kind != "CNN"

    def predict(
        self, images: NDArray[np.uint8], progress: Callable[[int], None] | None = None
    ) -> Predictions:
        """Predictions for pre-processed images, uint8 (N, size, size), as the network gives them.

        Raises
        ------
        ModelError
            If an answer is not finite, or has an inverse standard deviation that is not positive.
        """
        outputs = [_MEAN, _INVERSE_SIGMA] if self.has_uncertainty else [_MEAN]
        parts: list[list[NDArray[np.float32]]] = []
        for start in range(0, len(images), _BATCH):
            batch = as_input(images[start : start + _BATCH])
            parts.append(self.session.run(outputs, {INPUT_NAME: batch}))
            if progress is not None:
                progress(len(batch))
        arrays = [np.concatenate(column).astype(np.float64) for column in zip(*parts, strict=True)]
        for output, array in zip(outputs, arrays, strict=True):
            wrong = ~np.isfinite(array) if output == _MEAN else ~(np.isfinite(array) & (array > 0.0))
            if wrong.any():
                row = int(np.flatnonzero(wrong.any(axis=1))[0])
                raise ModelError(
                    f"{self.path}: answers {output} = {array[row]} to image {row}; must be finite"
                    + (" and positive" if output == _INVERSE_SIGMA else "")
                )
        return Predictions.from_inverse_sigma(*arrays) if self.has_uncertainty else Predictions(arrays[0])


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
    return [_open(path, name, threads) for path, name in zip(paths, names, strict=True)]


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
    outputs = [output.name for output in session.get_outputs()]
    if _MEAN not in outputs:
        raise ModelError(f"{path}: has the outputs {', '.join(outputs)}; must have {_MEAN}")
    return Model(name, path, "GDN" if _INVERSE_SIGMA in outputs else "CNN", metadata, session)
