"""A deep ensemble as one model file: the Gaussian with mean and covariance of the networks' mixture."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import onnx

from tactile_perception.datasets.dataset import read_dataset, training_part
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.model_metadata import (
    COVARIANCE,
    INPUT_NAME,
    INVERSE_SIGMA,
    MEAN,
    ModelMetadata,
    trained_model,
    unseen_rows,
)
from tactile_perception.evaluation.calibration import CalibrationSettings
from tactile_perception.training.export import GraphWriter, save_model
from tactile_perception.training.recalibration import fit_on


class EnsembleError(ValueError):
    """Networks that cannot be joined."""


def write_ensemble(runs: Sequence[Path | str], path: Path | str, data: Path | str | None = None) -> Path:
    """Join the models of run folders or ONNX files in one file with outputs `mu` and `covariance`.

    mean = average of the means; covariance = average of the covariances + covariance of the means.

    With `data`, the training data of the runs, the ensemble is calibrated on what all held out; without
    it has no calibration: those of its members do not hold for their mixture. `EnsembleError` or `ModelError`
    for fewer than two networks, or networks of other sizes, pre-processing or data.
    """
    files = [trained_model(Path(run)) for run in runs]
    if len(files) < 2:
        raise EnsembleError("an ensemble needs at least two networks")
    estimators = [Estimator(file) for file in files]
    metadata = _joined_metadata(files, [estimator.metadata for estimator in estimators])
    path = Path(path)
    _write(files, path, metadata)
    if data is not None:
        members = [estimator.metadata for estimator in estimators]
        _check_holdback(files, members)
        settings = CalibrationSettings.from_mapping(members[0].training.get("calibration", {}))
        _write(files, path, _calibrated(path, metadata, Path(data), settings))
    return path


def _joined_metadata(files: Sequence[Path], members: Sequence[ModelMetadata]) -> ModelMetadata:
    first = members[0]
    for file, member in zip(files, members, strict=True):
        if member.contact_model != first.contact_model:
            raise EnsembleError(
                f"{file}: tells {_told(member)}, and {files[0]} {_told(first)}: an ensemble needs the same"
            )
        if first.contact_model.turning:
            raise EnsembleError(
                f"{file}: '{first.contact_model.name}' has an angle that goes all round, of which several "
                "networks have no mean"
            )
        if member.preprocessing != first.preprocessing:
            difference = member.preprocessing.differences(first.preprocessing)
            raise EnsembleError(f"{file}: prepares images otherwise than {files[0]}: {difference}")
    facts = [{"validation": member.validation, **member.training} for member in members]
    return ModelMetadata(
        preprocessing=first.preprocessing,
        training_data=first.training_data,
        validation={},
        training={"members": facts},
        layout=first.layout,
        plain_depth=first.plain_depth,
        novelty=first.novelty,
        reference=first.reference,
        contact_model=first.contact_model,
    )


def _told(metadata: ModelMetadata) -> str:
    model = metadata.contact_model
    return f"'{model.name}' with labels of {', '.join(model.labelled)}"


def _write(files: Sequence[Path], path: Path, metadata: ModelMetadata) -> None:
    graph = GraphWriter()
    means, covariances, size = [], [], metadata.contact_model.size
    for index, file in enumerate(files):
        mean, covariance = _add_member(graph, onnx.load(str(file)), f"member{index}", size)
        means.append(mean)
        covariances.append(covariance)
    count = graph.constant("members", float(len(files)))
    graph.node("Div", [graph.node("Sum", means, "means.sum"), count], MEAN)
    spreads = []
    for index, mean in enumerate(means):
        difference = graph.node("Sub", [mean, MEAN], f"difference{index}")
        spreads.append(graph.outer(difference, difference, f"spread{index}", size))
    total = graph.node("Sum", covariances + spreads, "covariances.sum")
    graph.node("Div", [total, count], COVARIANCE)
    model = graph.model(
        metadata.preprocessing.channels, metadata.preprocessing.size, (MEAN, COVARIANCE), size
    )
    onnx.checker.check_model(model)
    save_model(model, path, metadata)


def _add_member(graph: GraphWriter, model: onnx.ModelProto, prefix: str, size: int) -> tuple[str, str]:
    """Add a model's nodes under new names; names of its mean and of its covariance (N, K, K)."""

    def renamed(name: str) -> str:
        return name if name in ("", INPUT_NAME) else f"{prefix}.{name}"

    for constant in model.graph.initializer:
        constant.name = renamed(constant.name)
    for node in model.graph.node:
        node.name = renamed(node.name)
        node.input[:] = [renamed(name) for name in node.input]
        node.output[:] = [renamed(name) for name in node.output]
    graph.constants += model.graph.initializer
    graph.nodes += model.graph.node
    mean, covariance, inverse = map(renamed, (MEAN, COVARIANCE, INVERSE_SIGMA))
    if COVARIANCE in [output.name for output in model.graph.output]:
        return mean, covariance
    squared = graph.node("Mul", [inverse, inverse], f"{prefix}.precision")
    variance = graph.node("Reciprocal", [squared], f"{prefix}.variance")
    return mean, graph.diagonal(variance, f"{prefix}.diagonal", size)


def _check_holdback(files: Sequence[Path], members: Sequence[ModelMetadata]) -> None:
    """`EnsembleError` unless there is a part of the same training data that none of the members has seen."""
    for file, member in zip(files, members, strict=True):
        if member.training.get("training", {}).get("holdback", 0.0) == 0.0:
            raise EnsembleError(
                f"{file}: was trained on all of its data, so that nothing is left to calibrate on; "
                "train with training.holdback, or leave out --data"
            )
        if member.training_data.get("sha256") != members[0].training_data.get("sha256"):
            raise EnsembleError(f"{file}: was trained on other data than {files[0]}")


def _calibrated(
    path: Path, metadata: ModelMetadata, data: Path, settings: CalibrationSettings
) -> ModelMetadata:
    train_dir = training_part(data)
    samples = read_dataset(train_dir, metadata.preprocessing, complete=False)
    if samples.sha256 != metadata.training_data.get("sha256"):
        raise EnsembleError(f"{train_dir}: is not what the networks were trained on")
    rows = unseen_rows(metadata, samples.sha256, len(samples))
    calibration = fit_on(Estimator(path), samples, rows, settings)
    return dataclasses.replace(metadata, calibration=calibration)
