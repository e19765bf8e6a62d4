"""Calibrate a trained model: on what it held out in training, or on samples of today's session."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from tactile_perception.datasets.dataset import TactileDataset, read_dataset
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.model_metadata import is_training_data, unseen_rows
from tactile_perception.estimating.novelty import Novelty
from tactile_perception.estimating.plain_depth import PlainDepth
from tactile_perception.evaluation.calibration import (
    Calibration,
    CalibrationError,
    CalibrationSettings,
    fit_calibration,
)
from tactile_perception.evaluation.models import predict_all
from tactile_perception.training.export import save_model

Array = NDArray[np.float64]


def recalibrate(
    model: Path | str, data: Path | str, out: Path | str, changes: Mapping[str, Any] | None = None
) -> tuple[Calibration, bool]:
    """Write a copy of a model file with a calibration fitted to labelled data.

    It gets a plain depth and a novelty as well, if it has none.

    The settings are those of the model's training. Margin and floor stand for what the training session
    cannot show of another one: data of another session show it, and get neither.

    Raises `CalibrationError` if the model has no uncertainty, was trained on all of the data, or the data are
    too few.

    Parameters
    ----------
    data : a labelled folder. Of the folder that the model was trained on, only what it held out is used.
    changes : settings of the calibration that are to be others

    Returns
    -------
    calibration : Calibration
    own_session : whether it was fitted to what the training held out, with margin and floor
    """
    estimator = Estimator(model)
    metadata = estimator.metadata
    if metadata.head == "mse":
        raise CalibrationError(f"{model}: the network has no uncertainty of its own to calibrate")
    samples = read_dataset(data, metadata.preprocessing, complete=False)
    rows = unseen_rows(metadata, samples.sha256, len(samples))
    if not len(rows):
        raise CalibrationError(
            f"{data}: the model was trained on all of these data: nothing is left to calibrate on; train "
            "with training.holdback, or calibrate on other data"
        )
    own_session = is_training_data(metadata, samples.sha256)
    settings = CalibrationSettings.from_mapping(metadata.training.get("calibration", {}))
    if not own_session:
        plain = CalibrationSettings()
        settings = settings.replaced(margin=plain.margin, floor=plain.floor)
    calibration = fit_on(estimator, samples, rows, settings.replaced(**(changes or {})))
    told = metadata.contact_model
    depth = metadata.plain_depth or PlainDepth.fit(samples.images, told.depths(samples.labels_for(told)))
    light = math.inf if metadata.preprocessing.binary else 0.0
    novelty = metadata.novelty or Novelty.fit(samples.images, light)
    changed = dataclasses.replace(metadata, calibration=calibration, plain_depth=depth, novelty=novelty)
    save_model(onnx.load(str(model)), out, changed)
    return calibration, own_session


def fit_on(
    estimator: Estimator, samples: TactileDataset, rows: NDArray[np.int64], settings: CalibrationSettings
) -> Calibration:
    """Fitted to the network's own answers to some rows of a data set."""
    labels, mean, cov, error = answers(estimator, samples, rows)
    return fit_calibration(labels, mean, cov, settings, error)


def answers(estimator: Estimator, samples: TactileDataset, rows: NDArray[np.int64]) -> tuple[Array, ...]:
    """Labels (n, K) of some rows, and a network's means, covariances (n, K, K) and errors there."""
    mean, cov = predict_all(estimator, samples.images[rows])
    model = estimator.metadata.contact_model
    labels = samples.labels_for(model)[rows]
    return labels, mean, cov, model.error(mean, labels)
