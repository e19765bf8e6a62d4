"""A deep ensemble as one model file: the Gaussian with mean and covariance of the networks' mixture."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import onnx
from onnx import helper

from tactile_base.whole_file import whole_file
from tactile_perception.datasets.dataset import read_dataset
from tactile_perception.estimating.model_metadata import (
    COVARIANCE,
    INPUT_NAME,
    INVERSE_SIGMA,
    MEAN,
    ModelMetadata,
    split_holdback,
)
from tactile_perception.estimator import Estimator
from tactile_perception.evaluation.calibration import CalibrationSettings
from tactile_perception.training.export import GraphWriter
from tactile_perception.training.recalibration import fit_on
from tactile_perception.training.run_folder import MODEL_NAME


class EnsembleError(ValueError):
    """Networks that cannot be joined."""


def write_ensemble(runs: Sequence[Path | str], path: Path | str, data: Path | str | None = None) -> Path:
    """Join the models of run folders or ONNX files in one file with outputs `mu` and `covariance`.

    mean = average of the means; covariance = average of the covariances + covariance of the means.

    Parameters
    ----------
    data : path, optional
        The training data of the runs; the ensemble is calibrated on what all of them held back. Without it
        the ensemble has no calibration: those of its members do not hold for their mixture.

    Raises
    ------
    EnsembleError, ModelError
        Fewer than two networks, or networks of other sizes, pre-processing or data.
    """
    files = [Path(run) / MODEL_NAME if Path(run).is_dir() else Path(run) for run in runs]
    if len(files) < 2:
        raise EnsembleError("an ensemble needs at least two networks")
    estimators = [Estimator(file) for file in files]
    metadata = _joined_metadata(files, [estimator.metadata for estimator in estimators])
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    _write(files, path, metadata)
    if data is not None:
        held_back = [estimator.metadata for estimator in estimators]
        holdback = _common_holdback(files, held_back)
        settings = CalibrationSettings.from_mapping(held_back[0].training.get("calibration", {}))
        metadata = _calibrated(path, metadata, holdback, Path(data), settings)
        _write(files, path, metadata)
    return path


def _joined_metadata(files: Sequence[Path], members: Sequence[ModelMetadata]) -> ModelMetadata:
    first = members[0]
    for file, member in zip(files, members, strict=True):
        if member.preprocessing != first.preprocessing:
            difference = member.preprocessing.differences(first.preprocessing)
            raise EnsembleError(f"{file}: prepares images otherwise than {files[0]}: {difference}")
    facts = [{"validation": member.validation, **member.training} for member in members]
    return ModelMetadata(
        preprocessing=first.preprocessing,
        training_data=first.training_data,
        validation={},
        training={"members": facts},
    )


def _write(files: Sequence[Path], path: Path, metadata: ModelMetadata) -> None:
    graph = GraphWriter()
    means, covariances = [], []
    for index, file in enumerate(files):
        mean, covariance = _add_member(graph, onnx.load(str(file)), f"member{index}")
        means.append(mean)
        covariances.append(covariance)
    count = graph.constant("members", float(len(files)))
    graph.node("Div", [graph.node("Sum", means, "means.sum"), count], MEAN)
    spreads = []
    for index, mean in enumerate(means):
        difference = graph.node("Sub", [mean, MEAN], f"difference{index}")
        spreads.append(graph.outer(difference, difference, f"spread{index}"))
    total = graph.node("Sum", covariances + spreads, "covariances.sum")
    graph.node("Div", [total, count], COVARIANCE)
    model = graph.model(metadata.preprocessing.size, (MEAN, COVARIANCE))
    helper.set_model_props(model, metadata.to_properties())
    onnx.checker.check_model(model)
    with whole_file(path) as temporary:
        onnx.save_model(model, str(temporary))


def _add_member(graph: GraphWriter, model: onnx.ModelProto, prefix: str) -> tuple[str, str]:
    """Add a model's nodes under new names; names of its mean and of its covariance (N, 6, 6)."""

    def renamed(name: str) -> str:
        return name if name in ("", INPUT_NAME) else f"{prefix}.{name}"

    for constant in model.graph.initializer:
        constant.name = renamed(constant.name)
        graph.constants.append(constant)
    for node in model.graph.node:
        node.name = renamed(node.name)
        node.input[:] = [renamed(name) for name in node.input]
        node.output[:] = [renamed(name) for name in node.output]
        graph.nodes.append(node)
    outputs = [output.name for output in model.graph.output]
    if COVARIANCE in outputs:
        return renamed(MEAN), renamed(COVARIANCE)
    inverse = renamed(INVERSE_SIGMA)
    squared = graph.node("Mul", [inverse, inverse], f"{prefix}.precision")
    variance = graph.node("Reciprocal", [squared], f"{prefix}.variance")
    return renamed(MEAN), graph.diagonal(variance, f"{prefix}.diagonal")


def _common_holdback(files: Sequence[Path], members: Sequence[ModelMetadata]) -> float:
    """The part of the training data that none of the members has seen."""
    parts = []
    for file, member in zip(files, members, strict=True):
        part = member.training.get("training", {}).get("holdback", 0.0)
        if part == 0.0:
            raise EnsembleError(
                f"{file}: was trained on all of its data, so that nothing is left to calibrate on; "
                "train with training.holdback, or leave out --data"
            )
        if member.training_data.get("sha256") != members[0].training_data.get("sha256"):
            raise EnsembleError(f"{file}: was trained on other data than {files[0]}")
        parts.append(float(part))
    # The held-back samples of a smaller part are among those of a larger one.
    return min(parts)


def _calibrated(
    path: Path, metadata: ModelMetadata, holdback: float, data: Path, settings: CalibrationSettings
) -> ModelMetadata:
    train_dir = data / "train" if (data / "train").is_dir() else data
    samples = read_dataset(train_dir, metadata.preprocessing)
    if samples.sha256 != metadata.training_data.get("sha256"):
        raise EnsembleError(f"{train_dir}: is not what the networks were trained on")
    _, chosen = split_holdback(len(samples), holdback)
    calibration = fit_on(Estimator(path), samples, chosen, settings)
    return dataclasses.replace(metadata, calibration=calibration)
