"""Which samples of its training data a model has not seen: those held back to calibrate it on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_perception.estimating.model_metadata import ModelMetadata


def split_holdback(count: int, part: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows to train on, and rows held back; the same for every seed, so that ensembles share them."""
    order = np.random.default_rng(0).permutation(count)
    number = round(part * count)
    return np.sort(order[number:]), np.sort(order[:number])


def unseen_rows(metadata: ModelMetadata, sha256: str, count: int) -> NDArray[np.int64]:
    """Rows of a data set that a model (of an ensemble: every member) was not trained on.

    Parameters
    ----------
    sha256, count : of the data set, as `dataset.read_dataset` finds them

    Returns
    -------
    array of int
        All rows of data that are not the training data; empty where nothing was held back of those.
    """
    used = _parts_held_back(metadata, sha256)
    # The held-back samples of a smaller part are among those of a larger one.
    return split_holdback(count, min(used))[1] if used else np.arange(count)


def is_training_data(metadata: ModelMetadata, sha256: str) -> bool:
    """Whether a model, or what it was started from, was trained on this data set."""
    return bool(_parts_held_back(metadata, sha256))


def _parts_held_back(metadata: ModelMetadata, sha256: str) -> list[float]:
    """What part of a data set each network held back that was trained on it; empty for other data."""
    data, runs = metadata.training_data, metadata.training.get("members", [metadata.training])
    parts = [float(run.get("training", {}).get("holdback", 0.0)) for run in runs]
    used = [] if data.get("sha256") != sha256 else parts
    while "start" in data:  # what an earlier network learned from, this one has seen, too
        data = data["start"]
        used += [float(data.get("holdback", 0.0))] if data.get("sha256") == sha256 else []
    return used
