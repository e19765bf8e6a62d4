"""Evaluation of several models on one data folder: predictions, results, and their means over the models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_perception.datasets.dataset import DatasetError, DatasetReport, TactileDataset, read_dataset
from tactile_perception.estimating.contact_model import POSE, SURFACE, ContactModel
from tactile_perception.estimating.model_metadata import unseen_rows
from tactile_perception.estimating.preprocessing import PreprocessingSettings, as_input
from tactile_perception.evaluation import metrics
from tactile_perception.evaluation.calibration import fit_calibration
from tactile_perception.evaluation.metrics import Accuracy, Bins, Consistency, Predictions
from tactile_perception.evaluation.models import Model

Array = NDArray[np.float64]
ENSEMBLE = "ensemble"


@dataclass(frozen=True)
class EvaluationData:
    """Labels of a folder and its images, pre-processed as each model wants them.

    Attributes
    ----------
    labels : (N, K) what the networks are to say (xi_sf) in mm, rad and N; NaN: not labelled
    euler_mm_deg : (N, 6) Euler surface contact pose
    images : by pre-processing, uint8 (N, size, size)
    notes : what a reader of the results should know about folder and models
    model : what the networks tell
    compared : which of its quantities are labelled here and fixed in the networks
    """

    folder: Path
    names: list[str]
    labels: Array
    euler_mm_deg: Array
    images: dict[PreprocessingSettings, NDArray[np.uint8]]
    sha256: str
    report: DatasetReport
    notes: list[str] = field(default_factory=list)
    model: ContactModel = SURFACE
    compared: tuple[int, ...] = tuple(range(SURFACE.size))

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def targets(self) -> Array:
        """The labels of what is compared (N, C)."""
        return self.labels[:, list(self.compared)]


@dataclass(frozen=True)
class Assessment:
    """Results of one set of predictions; what needs uncertainty is None without."""

    predictions: Predictions
    consistency: Consistency | None
    by_sigma: list[Bins] | None
    by_depth: Bins
    by_shear: Bins


@dataclass(frozen=True)
class ModelResult:
    """Results of a model (or ensemble) as it answers and, where it has a calibration, calibrated.

    Attributes
    ----------
    names, units : of what is compared
    """

    name: str
    kind: str
    accuracy: Accuracy
    raw: Assessment
    calibrated: Assessment | None = None
    calibration_source: str = ""
    members: int = 1
    names: tuple[str, ...] = SURFACE.names
    units: tuple[str, ...] = SURFACE.units

    @property
    def titles(self) -> list[str]:
        """Names and units of what is compared."""
        return [f"{name} ({unit})" for name, unit in zip(self.names, self.units, strict=True)]

    @property
    def columns(self) -> list[str]:
        """The same for columns of files."""
        return [f"{name}_{unit}" for name, unit in zip(self.names, self.units, strict=True)]

    @property
    def best(self) -> Assessment:
        """The calibrated results, else the raw ones."""
        return self.calibrated or self.raw


def load_data(
    folder: Path | str,
    models: Sequence[Model],
    limit: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> EvaluationData:
    """Read a labelled folder of the public layout, pre-processed as each of the models was trained.

    Of training data only what was held out is taken.

    Raises `DatasetError` if the folder has no labels, no images, or nothing usable, or a model was trained on
    all of it.
    """
    folder = Path(folder)
    _check_folder(folder)
    wanted = list(dict.fromkeys(model.metadata.preprocessing for model in models))
    told = _told(models)
    sets = [read_dataset(folder, settings, progress=progress, complete=False) for settings in wanted]
    first = sets[0]
    rows, notes = _rows_to_use(folder, first, models)
    labels = first.labels_for(told)
    known = np.logical_and.reduce([model.metadata.contact_model.known for model in models])
    compared = np.flatnonzero(known & [name in first.labelled for name in told.quantity_names])
    whole = np.isfinite(labels[np.ix_(rows, compared)]).all(axis=1)
    if not whole.any():
        listed = ", ".join(told.quantity_names[k] for k in compared)
        raise DatasetError(f"{folder}: no sample has all of the labels {listed}")
    if not whole.all():
        notes.append(f"{np.count_nonzero(~whole)} samples without all of these labels are left out")
        rows = rows[whole]
    if len(compared) < told.size:
        listed = ", ".join(told.quantity_names[k] for k in range(told.size) if k not in compared)
        notes.append(f"not compared, since not labelled here or in training: {listed}")
    if limit is not None and limit < len(rows):
        rows = rows[np.linspace(0, len(rows) - 1, limit).round().astype(int)]
        notes.append(f"took {limit} samples, spread over the table")
    images = {settings: found.images[rows] for settings, found in zip(wanted, sets, strict=True)}
    notes += [_familiarity(model, images[model.metadata.preprocessing]) for model in models]
    return EvaluationData(
        folder=folder,
        names=[first.names[row] for row in rows],
        labels=labels[rows],
        euler_mm_deg=first.euler_mm_deg[rows],
        images=images,
        sha256=first.sha256,
        report=first.report,
        notes=list(filter(None, notes)),
        model=told,
        compared=tuple(compared.tolist()),
    )


def _told(models: Sequence[Model]) -> ContactModel:
    """What the models tell; `DatasetError` if it is not the same."""
    first = models[0].metadata.contact_model
    for model in models:
        if model.metadata.contact_model.columns != first.columns:
            raise DatasetError(
                f"{model.name} tells {', '.join(model.metadata.components)}, and {models[0].name} "
                f"{', '.join(first.names)}: evaluate them one by one"
            )
    return first


def _familiarity(model: Model, images: NDArray[np.uint8]) -> str:
    """How many images are foreign to a model; empty where it cannot tell."""
    measure = model.metadata.novelty
    if measure is None:
        return ""
    found = np.array([measure(as_input(image)) for image in images])
    median = float(np.median(found))
    return (
        f"{(found > 1.0).mean():.1%} of the images are foreign to {model.name} (novelty {median:.2f}, median)"
    )


def _check_folder(folder: Path) -> None:
    """Name the parts of a folder of splits instead of saying that it has no table."""
    if not folder.is_dir() or list(folder.glob("targets*.csv")):
        return
    parts = sorted(table.parent.name for table in folder.glob("*/targets*.csv"))
    if parts:
        listed = ", ".join(parts)
        raise DatasetError(f"{folder}: holds the parts {listed}; evaluate one of them: {folder / parts[-1]}")


def _rows_to_use(
    folder: Path, data: TactileDataset, models: Sequence[Model]
) -> tuple[NDArray[np.int64], list[str]]:
    """Rows that no model was trained on, and what a reader of the results should know about them.

    Raises `DatasetError` if there are none: results on them would be flattered.
    """
    rows, notes = np.arange(len(data)), []
    for model in models:
        unseen = unseen_rows(model.metadata, data.sha256, len(data))
        if not len(unseen):
            raise DatasetError(
                f"{folder}: {model.name} was trained on all of these data, where its errors are too small; "
                "take others, or a model trained with training.holdback"
            )
        rows = np.intersect1d(rows, unseen)
        if model.metadata.training_data.get("validation_sha256") == data.sha256:
            notes.append(f"{model.name}'s best epoch was chosen on these data")
    if len(rows) < len(data):
        notes.append(
            f"only the {len(rows)} samples held out from training, to which the models were calibrated"
        )
    return rows, notes


def evaluate(
    data: EvaluationData,
    models: Sequence[Model],
    ensemble: bool = False,
    calibration_data: EvaluationData | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[ModelResult]:
    """Results of each model, and of the models together.

    Parameters
    ----------
    ensemble : also evaluate the moment-matched mixture of all models with, and of all without uncertainty
    calibration_data : calibrate on these instead of using the calibration in the model files
    """
    if calibration_data is not None and calibration_data.sha256 == data.sha256:
        data.notes.append("calibrated on the data evaluated, each half on the other: as of the same session")
    predictions = [predict(model, data, progress) for model in models]
    if calibration_data is None:
        calibrated = [_by_model_file(*pair) for pair in zip(models, predictions, strict=True)]
    else:
        held_out = [predict(model, calibration_data, progress) for model in models]
        calibrated = [
            _fitted(data, calibration_data, *pair) for pair in zip(predictions, held_out, strict=True)
        ]
    results = [
        assess(model.name, model.kind, data, own, *better)
        for model, own, better in zip(models, predictions, calibrated, strict=True)
    ]
    if not ensemble:
        return results
    for uncertain in (False, True):
        chosen = [index for index, model in enumerate(models) if model.has_uncertainty is uncertain]
        if len(chosen) < 2:
            continue
        mixture = metrics.moment_matched([predictions[index] for index in chosen])
        if calibration_data is not None:
            held_mixture = metrics.moment_matched([held_out[index] for index in chosen])
            better = _fitted(data, calibration_data, mixture, held_mixture)
        else:
            better = _of_calibrated_members([calibrated[index][0] for index in chosen])
        kinds = list(dict.fromkeys(models[index].kind for index in chosen))
        name = f"{ENSEMBLE} of {len(chosen)} {kinds[0] if len(kinds) == 1 else 'networks'}"
        results.append(assess(name, name, data, mixture, *better, members=len(chosen)))
    return results


Calibrated = tuple[Predictions | None, str]


def _by_model_file(model: Model, predictions: Predictions) -> Calibrated:
    """Predictions calibrated as the model file says; None without a calibration."""
    calibration = model.metadata.calibration
    if predictions.cov is None or calibration.is_identity:
        return None, ""
    return predictions.calibrated(calibration), f"model file, fitted on {calibration.samples} samples"


def _fitted(
    data: EvaluationData, calibration_data: EvaluationData, predictions: Predictions, held_out: Predictions
) -> Calibrated:
    """Predictions calibrated on other data; if those are the same, each half of them on the other half."""
    if predictions.cov is None or held_out.cov is None:
        return None, ""
    if calibration_data.sha256 != data.sha256:
        fitted = fit_calibration(calibration_data.labels, held_out.mean, held_out.cov)
        source = f"fitted on {fitted.samples} samples of {calibration_data.folder}"
        return predictions.calibrated(fitted), source
    cov = np.empty_like(predictions.cov)
    half = np.random.default_rng(0).permutation(len(data)) % 2 == 0
    for fit, use in ((half, ~half), (~half, half)):
        fitted = fit_calibration(data.labels[fit], predictions.mean[fit], predictions.cov[fit])
        cov[use] = fitted.covariance(predictions.mean[use], predictions.cov[use])
    return Predictions(predictions.mean, cov), "each half of the data fitted on the other half"


def _of_calibrated_members(members: Sequence[Predictions | None]) -> Calibrated:
    known = [member for member in members if member is not None]
    if len(known) < len(members):
        return None, ""
    return metrics.moment_matched(known), "calibrated members"


def predict(model: Model, data: EvaluationData, progress: Callable[[int], None] | None = None) -> Predictions:
    """A model's own predictions for all samples of the data, angles as near to their labels as they are."""
    found = model.predict(data.images[model.metadata.preprocessing], progress)
    if not (turning := list(data.model.turning)):
        return found
    mean = found.mean.copy()
    mean[:, turning] = (data.labels + data.model.error(found.mean, data.labels))[:, turning]
    return Predictions(mean, found.cov)


def assess(
    name: str,
    kind: str,
    data: EvaluationData,
    predictions: Predictions,
    calibrated: Predictions | None = None,
    source: str = "",
    members: int = 1,
) -> ModelResult:
    """Everything about one set of predictions, before and after calibration."""
    compared, told = data.compared, data.model
    euler = metrics.euler_error(data.euler_mm_deg, told.euler(predictions.mean))
    euler[:, [k for k in range(POSE) if k not in compared]] = np.nan
    predictions = predictions.columns(compared)
    units = tuple(told.units[k] for k in compared)
    return ModelResult(
        name=name,
        kind=kind,
        accuracy=metrics.accuracy(data.targets, euler, predictions, units),
        raw=_assessment(data, predictions),
        calibrated=None if calibrated is None else _assessment(data, calibrated.columns(compared)),
        calibration_source=source,
        members=members,
        names=tuple(told.names[k] for k in compared),
        units=units,
    )


def _assessment(data: EvaluationData, predictions: Predictions) -> Assessment:
    depth, shear = data.euler_mm_deg[:, 2], metrics.shear_of(data.euler_mm_deg)
    uncertain = predictions.cov is not None
    return Assessment(
        predictions=predictions,
        consistency=metrics.consistency(data.targets, predictions) if uncertain else None,
        by_sigma=metrics.by_predicted_sigma(data.targets, predictions) if uncertain else None,
        by_depth=metrics.binned(data.targets, predictions, depth, metrics.depth_edges(depth)),
        by_shear=metrics.binned(data.targets, predictions, shear, metrics.depth_edges(shear)),
    )
