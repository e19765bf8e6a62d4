"""What a model file says about itself, written at export and checked by the estimator; what data it saw."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError
from tactile_perception.estimating.labels import COMPONENTS, NETWORK_UNITS
from tactile_perception.estimating.preprocessing import PreprocessingSettings
from tactile_perception.evaluation.calibration import Calibration, CalibrationError

FORMAT = "tactile_servoing.gdn/1"
INPUT_NAME = "image"
MEAN, INVERSE_SIGMA, COVARIANCE = "mu", "inverse_sigma", "covariance"
#: Shapes after the batch axis. A model has `mu` and one of the other two.
OUTPUT_SHAPES = {MEAN: (6,), INVERSE_SIGMA: (6,), COVARIANCE: (6, 6)}
#: Models in a run folder, the one to take first.
RUN_MODELS = QUANTIZED_NAME, MODEL_NAME = "model_int8.onnx", "model.onnx"
FRAMES = (
    "xi = [rho, phi] = ln(X_sf): the surface feature frame {f} in the sensor frame {s}. {s}: origin at the "
    "center of the hemispherical tip, z out of the tip. {f}: z into the surface, aligned with {s} where the "
    "sensor just touches; inverse_sigma or covariance: of the components of xi around mu"
)
_REQUIRED = ("format", "preprocessing", "components", "units", "frames", "training_data", "validation")


def trained_model(run: Path) -> Path:
    """The model of a run folder as it was trained; a model file stands for itself."""
    return run / MODEL_NAME if run.is_dir() else run


class MetadataError(ValueError):
    """A model file without the entries that its use needs, or with entries of another convention."""


@dataclass(frozen=True)
class ModelMetadata:
    """Contents of an ONNX file's `metadata_props`.

    Attributes
    ----------
    preprocessing : how the training images were made from camera images
    training_data : number of samples and SHA-256 of training and validation data
    validation : loss and mean absolute error per component (mm, rad) on the validation data
    training : every setting of network, training and augmentation; for an ensemble, its members
    calibration : of the stated uncertainty, fitted on held-back training data; applied by who uses the model
    """

    preprocessing: PreprocessingSettings
    training_data: dict[str, Any]
    validation: dict[str, Any]
    training: dict[str, Any] = field(default_factory=dict)
    calibration: Calibration = field(default_factory=Calibration)
    components: tuple[str, ...] = COMPONENTS
    units: tuple[str, ...] = NETWORK_UNITS
    frames: str = FRAMES

    @property
    def head(self) -> str:
        """Kind of the network's head, as `network.head` in its training settings; "ensemble" for an ensemble.

        A network with the head "mse" has no uncertainty of its own: its file states the deviations of its
        errors on validation data, the same for every image.
        """
        network = self.training.get("network", {})
        default = "ensemble" if "members" in self.training else "gaussian"
        return str(network.get("head", default)) if isinstance(network, dict) else default

    def to_properties(self) -> dict[str, str]:
        """As the strings that an ONNX file holds; everything but `format` is JSON."""
        values = {item.name: getattr(self, item.name) for item in dataclasses.fields(self)}
        values["preprocessing"] = dataclasses.asdict(self.preprocessing)
        calibration = values.pop("calibration")
        texts = {name: json.dumps(value) for name, value in values.items()}
        return {"format": FORMAT, **texts, "calibration": calibration.to_json()}

    @classmethod
    def from_properties(cls, properties: Mapping[str, str]) -> ModelMetadata:
        """The reverse; `MetadataError` names what is missing or different and what would be right."""
        missing = [name for name in _REQUIRED if name not in properties]
        if missing:
            raise MetadataError(
                f"metadata has no {', '.join(missing)}: was the model exported by `tactile train`?"
            )
        if properties["format"] != FORMAT:
            raise MetadataError(f"format is '{properties['format']}', must be '{FORMAT}'")
        try:
            values = {name: json.loads(properties[name]) for name in _JSON_NAMES if name in properties}
            values["preprocessing"] = PreprocessingSettings.from_mapping(values["preprocessing"])
            if "calibration" in properties:
                values["calibration"] = Calibration.from_json(properties["calibration"])
        except (json.JSONDecodeError, SettingError, CalibrationError, TypeError) as error:
            raise MetadataError(f"unreadable metadata: {error}") from error
        for name, expected in (("units", NETWORK_UNITS), ("components", COMPONENTS)):
            values[name] = tuple(values[name])
            if values[name] != expected:
                raise MetadataError(f"{name} are {values[name]}, must be {expected}")
        return cls(**values)


_JSON_NAMES = tuple(item.name for item in dataclasses.fields(ModelMetadata) if item.name != "calibration")


def split_holdback(count: int, part: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows to train on, and rows held back; the same for every seed, so that ensembles share them."""
    order = np.random.default_rng(0).permutation(count)
    number = round(part * count)
    return np.sort(order[number:]), np.sort(order[:number])


def unseen_rows(metadata: ModelMetadata, sha256: str, count: int) -> NDArray[np.int64]:
    """Rows of a data set that a model (of an ensemble: every member) was not trained on.

    All of them for other data than its training data; none where nothing was held back of those. `sha256` and
    `count` are those of the data set, as `dataset.read_dataset` finds them.
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
