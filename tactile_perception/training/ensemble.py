"""Several networks joined in one model file: of other seeds, or each without another part of the data."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray

from tactile_perception.datasets.dataset import TactileDataset, read_dataset, training_part
from tactile_perception.estimating.contact_model import ContactModel
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
from tactile_perception.evaluation.calibration import CalibrationSettings, fit_calibration
from tactile_perception.training.export import GraphWriter, save_model
from tactile_perception.training.recalibration import answers, fit_on


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
    members = [Estimator(file).metadata for file in files]
    metadata = _joined_metadata(files, members)
    path = Path(path)
    _write(files, path, metadata)
    if data is not None:
        _check_holdback(files, members)
        samples = _training_data(Path(data), metadata)
        rows = unseen_rows(metadata, samples.sha256, len(samples))
        calibration = fit_on(Estimator(path), samples, rows, _settings(members))
        _write(files, path, dataclasses.replace(metadata, calibration=calibration))
    return path


def write_folds(
    runs: Sequence[Path | str], path: Path | str, data: Path | str | TactileDataset
) -> NDArray[np.float64]:
    """Join networks that each held out another part of the same training data; their mean errors there.

    mean = average of the means; covariance = average of the covariances, calibrated on what each network says
    of the part that it held out, so that all data are learned from and all calibrate. The spread of the means
    is no part of it: the mean squared error of one network is that of their average and the spread (Krogh and
    Vedelsby, 1995), and it is the error of one that calibrates. Raises as `write_ensemble`.

    Parameters
    ----------
    data : the folder that they were trained on, or what was read of it

    Returns
    -------
    ndarray (K,) : mean absolute errors of the single networks there; NaN where nothing is labelled
    """
    files = [trained_model(Path(run)) for run in runs]
    estimators = [Estimator(file) for file in files]
    members = [estimator.metadata for estimator in estimators]
    metadata = _joined_metadata(files, members)
    _check_holdback(files, members)
    samples = data if isinstance(data, TactileDataset) else _training_data(Path(data), metadata)
    found = [
        answers(estimator, samples, unseen_rows(estimator.metadata, samples.sha256, len(samples)))
        for estimator in estimators
    ]
    known, means, covariances, error = (np.concatenate(part) for part in zip(*found, strict=True))
    calibration = fit_calibration(known, means, covariances, _settings(members), error)
    _write(files, Path(path), dataclasses.replace(metadata, calibration=calibration), spread=False)
    told = np.isfinite(error).any(axis=0)
    return np.where(told, np.nanmean(np.abs(np.where(told, error, 0.0)), axis=0), np.nan)


def _settings(members: Sequence[ModelMetadata]) -> CalibrationSettings:
    return CalibrationSettings.from_mapping(members[0].training.get("calibration", {}))


def _training_data(folder: Path, metadata: ModelMetadata) -> TactileDataset:
    """What the networks were trained on; `EnsembleError` if it is not."""
    train_dir = training_part(folder)
    samples = read_dataset(train_dir, metadata.preprocessing, complete=False)
    if samples.sha256 != metadata.training_data.get("sha256"):
        raise EnsembleError(f"{train_dir}: is not what the networks were trained on")
    return samples


def _joined_metadata(files: Sequence[Path], members: Sequence[ModelMetadata]) -> ModelMetadata:
    if len(files) < 2:
        raise EnsembleError("an ensemble needs at least two networks")
    first = members[0]
    for file, member in zip(files, members, strict=True):
        if member.contact_model != first.contact_model:
            raise EnsembleError(
                f"{file}: tells {_told(member)}, and {files[0]} {_told(first)}: an ensemble needs the same"
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


def _write(files: Sequence[Path], path: Path, metadata: ModelMetadata, spread: bool = True) -> None:
    """The model file; with or without the means' spread in its covariance."""
    graph = GraphWriter()
    means, covariances, size = [], [], metadata.contact_model.size
    for index, file in enumerate(files):
        mean, covariance = _add_member(graph, onnx.load(str(file)), f"member{index}", size)
        means.append(mean)
        covariances.append(covariance)
    means = _beside_the_first(graph, means, metadata.contact_model)
    count = graph.constant("members", float(len(files)))
    graph.node("Div", [graph.node("Sum", means, "means.sum"), count], MEAN)
    terms = list(covariances)
    for index, mean in enumerate(means if spread else []):
        difference = graph.node("Sub", [mean, MEAN], f"difference{index}")
        terms.append(graph.outer(difference, difference, f"spread{index}", size))
    total = graph.node("Sum", terms, "covariances.sum")
    graph.node("Div", [total, count], COVARIANCE)
    model = graph.model(
        metadata.preprocessing.channels, metadata.preprocessing.size, (MEAN, COVARIANCE), size
    )
    onnx.checker.check_model(model)
    save_model(model, path, metadata)


def _beside_the_first(graph: GraphWriter, means: list[str], model: ContactModel) -> list[str]:
    """Names of the means (N, K) with angles that go all round less than half a circle from the first's."""
    if not model.turning:
        return means
    circle = graph.constant("circle", 2.0 * np.pi)
    place = np.isin(np.arange(model.size), model.turning)
    turned = graph.constant("circle.of_angles", 2.0 * np.pi * place)
    beside = means[:1]
    for index, mean in enumerate(means[1:], 1):
        name = f"member{index}.circles"
        part = graph.node("Div", [graph.node("Sub", [mean, means[0]], f"{name}.off"), circle], f"{name}.part")
        taken_off = graph.node("Mul", [graph.node("Round", [part], name), turned], f"{name}.angles")
        beside.append(graph.node("Sub", [mean, taken_off], f"{name}.beside"))
    return beside


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
