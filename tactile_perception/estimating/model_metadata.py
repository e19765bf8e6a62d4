"""What a model file says about itself, written at export and checked by the estimator; what data it saw."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.input_file import parse_json
from tactile_base.settings import shown
from tactile_perception.estimating.contact_model import SURFACE, ContactModel
from tactile_perception.estimating.image import Image, packed, unpacked
from tactile_perception.estimating.layout import Layout
from tactile_perception.estimating.novelty import Novelty
from tactile_perception.estimating.plain_depth import PlainDepth
from tactile_perception.estimating.preprocessing import PreprocessingSettings
from tactile_perception.evaluation.calibration import Calibration

FORMAT = "tactile_servoing.gdn/1"
INPUT_NAME = "image"
MEAN, INVERSE_SIGMA, COVARIANCE = "mu", "inverse_sigma", "covariance"
#: Models in a run folder, the one to take first.
RUN_MODELS = QUANTIZED_NAME, MODEL_NAME = "model_int8.onnx", "model.onnx"
#: In the folder of a run, once it is finished.
RESULT_NAME = "result.json"
FRAMES = (
    "xi = [rho, phi] = ln(X_sf): the surface feature frame {f} in the sensor frame {s}. {s}: origin at the "
    "center of the hemispherical tip, z out of the tip. {f}: z into the surface, aligned with {s} where the "
    "sensor just touches; inverse_sigma or covariance: of the components around mu. Where they are x, y, z, "
    "alpha, beta, gamma, they are those of X_fs itself (extrinsic xyz)"
)
LAYOUT, PLAIN_DEPTH, NOVELTY, REFERENCE = "layout", "plain_depth", "novelty", "reference"
#: Entry with the SHA-256 of the whole file as it is with `UNSUMMED` in the entry's place.
CHECKSUM = "file_sha256"
UNSUMMED = "-" * 64
#: As protobuf writes it: the key, the number of the value's field, its length, the value.
_SUM_ENTRY = re.compile(CHECKSUM.encode() + rb"\x12\x40(.{64})", re.DOTALL)
_SECTIONS = ("network", "training", "augmentation", "calibration")
#: What has to be said where the shipped model sees a real sensor.
SIMULATED_ONLY = (
    "the shipped model has seen simulated images alone: of a real sensor it only guesses; train one of your "
    "own (docs/own_sensor.md)"
)
_VIEWS = LAYOUT, PLAIN_DEPTH, NOVELTY, REFERENCE  # of the training images, with texts of their own
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
    calibration : of the stated uncertainty, fitted on held-out training data; applied by who uses the model
    layout : mean of the training images, by which a camera is known that is mirrored or turned; None: not
    known
    plain_depth : depth by a weighted sum of brightness, which the network is held against; None: not known
    novelty : whether an image is like those of the training; None: not known
    reference : the training's image without contact, where images are compared with it
    contact_model : what the network tells, and what labels have fixed of it; a file without it: a surface
    """

    preprocessing: PreprocessingSettings
    training_data: dict[str, Any]
    validation: dict[str, Any]
    training: dict[str, Any] = field(default_factory=dict)
    calibration: Calibration = field(default_factory=Calibration)
    layout: Layout | None = None
    plain_depth: PlainDepth | None = None
    novelty: Novelty | None = None
    reference: Image | None = None
    contact_model: ContactModel = SURFACE
    frames: str = FRAMES

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the network's outputs."""
        return self.contact_model.names

    @property
    def units(self) -> tuple[str, ...]:
        """Their units."""
        return self.contact_model.units

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
        values["contact_model"] = self.contact_model.plain()
        values |= {"components": self.components, "units": self.units}
        calibration, views = values.pop("calibration"), {name: values.pop(name) for name in _VIEWS}
        texts = {name: json.dumps(value) for name, value in values.items()}
        texts |= {
            name: packed(view) if name == REFERENCE else view.to_text()
            for name, view in views.items()
            if view is not None
        }
        return {"format": FORMAT, **texts, "calibration": calibration.to_json(), CHECKSUM: UNSUMMED}

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
            values = {name: parse_json(properties[name]) for name in _JSON_NAMES if name in properties}
            values["preprocessing"] = PreprocessingSettings.from_mapping(values["preprocessing"])
            model = ContactModel.from_plain(values["contact_model"]) if "contact_model" in values else SURFACE
            values["contact_model"] = model
            if "calibration" in properties:
                values["calibration"] = Calibration.from_json(properties["calibration"])
            if LAYOUT in properties:
                values[LAYOUT] = Layout.from_text(properties[LAYOUT], values["preprocessing"].size)
            if PLAIN_DEPTH in properties:
                values[PLAIN_DEPTH] = PlainDepth.from_text(properties[PLAIN_DEPTH])
            if NOVELTY in properties:
                values[NOVELTY] = Novelty.from_text(properties[NOVELTY], values["preprocessing"])
            values[REFERENCE] = _reference(properties.get(REFERENCE), values["preprocessing"])
        except (ValueError, TypeError) as error:
            raise MetadataError(f"unreadable metadata: {error}") from error
        for name, expected in (("units", model.units), ("components", model.names)):
            found = values.pop(name)
            if found != list(expected):
                raise MetadataError(f"{name} are {shown(found)}, must be {list(expected)}")
        calibration = values.get("calibration", Calibration())
        if not calibration.is_identity and calibration.size != model.size:
            raise MetadataError(f"calibration: is not of the {model.size} quantities of the contact model")
        _check_facts(values)
        return cls(**values)


def _reference(text: str | None, settings: PreprocessingSettings) -> Image | None:
    """The image without contact of a file; `ValueError` where it lacks one that it needs."""
    if not settings.difference:
        return None
    if text is None:
        raise MetadataError(f"has no {REFERENCE}, with which preprocessing.difference compares")
    return unpacked(text, REFERENCE, settings.color)


_JSON_NAMES = (
    *(item.name for item in dataclasses.fields(ModelMetadata) if item.name not in ("calibration", *_VIEWS)),
    "components",
    "units",
)


def output_shapes(size: int) -> dict[str, tuple[int, ...]]:
    """Shapes after the batch axis, for so many quantities. A model has `mu` and one of the other two."""
    return {MEAN: (size,), INVERSE_SIGMA: (size,), COVARIANCE: (size, size)}


def _check_facts(values: Mapping[str, Any]) -> None:
    """`MetadataError` unless what the file says of its training has the form in which it is looked at."""
    _mapping("validation", values["validation"])
    training = _mapping("training", values.get("training", {}))
    members = training.get("members", [training])
    if not isinstance(members, list):
        raise MetadataError(f"training.members is {shown(members)}, must be a list")
    for run in members:
        for section in _SECTIONS:
            _mapping(f"training.{section}", _mapping("training.members", run).get(section, {}))
        _check_holdback(run.get("training", {}))
    data = _mapping("training_data", values["training_data"])
    while "start" in data:
        data = _mapping("training_data.start", data["start"])
        _check_holdback(data)


def _mapping(name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise MetadataError(f"{name} is {shown(value)}, must hold names and values")
    return value


def _check_holdback(values: Mapping[str, Any]) -> None:
    part = values.get("holdback", 0.0)
    if not isinstance(part, int | float) or not 0.0 <= part < 1.0:
        raise MetadataError(f"holdback is {shown(part)}, must be a part of the data, 0 to 1")
    fold = values.get("fold", 0)
    if not isinstance(fold, int) or not 0 <= fold < 1000:
        raise MetadataError(f"fold is {shown(fold)}, must be a whole number, which part is held back")


def summed(data: bytes) -> bytes:
    """A model file, made with `UNSUMMED` as its `CHECKSUM`, with the checksum in that place."""
    return data.replace(UNSUMMED.encode(), hashlib.sha256(data).hexdigest().encode(), 1)


def check_sum(data: bytes) -> bool:
    """`MetadataError` if a model file is not as it was written; False if it has no checksum that would tell.

    It looks at the bytes alone, so that nothing is made of a damaged file.
    """
    entry = _SUM_ENTRY.search(data)
    if entry is None or entry[1] == UNSUMMED.encode():
        return False
    unsummed = data[: entry.start(1)] + UNSUMMED.encode() + data[entry.end(1) :]
    if hashlib.sha256(unsummed).hexdigest().encode() != entry[1]:
        raise MetadataError(f"is damaged: its contents do not fit the checksum in it, {CHECKSUM}")
    return True


def split_holdback(count: int, part: float, fold: int = 0) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows to train on, and rows held out; the same for every seed, so that ensembles share them.

    `fold` says which: the first 1 / part of them hold out each row once.
    """
    begin, end = (round(each * part * count) for each in (fold, fold + 1))
    order = np.roll(np.random.default_rng(0).permutation(count), -begin)
    return np.sort(order[end - begin :]), np.sort(order[: end - begin])


def unseen_rows(metadata: ModelMetadata, sha256: str, count: int) -> NDArray[np.int64]:
    """Rows of a data set that a model (of an ensemble: every member) was not trained on.

    All of them for other data than its training data; none where nothing was held out of those. `sha256` and
    `count` are those of the data set, as `dataset.read_dataset` finds them.
    """
    held_out = [split_holdback(count, *each)[1] for each in set(_parts_held_out(metadata, sha256))]
    return reduce(np.intersect1d, held_out, np.arange(count))


def is_training_data(metadata: ModelMetadata, sha256: str) -> bool:
    """Whether a model, or what it was started from, was trained on this data set."""
    return bool(_parts_held_out(metadata, sha256))


def _parts_held_out(metadata: ModelMetadata, sha256: str) -> list[tuple[float, int]]:
    """What part of a data set, and which, each network held out that was trained on it; empty for others."""
    data, runs = metadata.training_data, metadata.training.get("members", [metadata.training])
    used = [_held_out(run.get("training", {})) for run in runs] if data.get("sha256") == sha256 else []
    while "start" in data:  # what an earlier network learned from, this one has seen, too
        data = data["start"]
        used += [_held_out(data)] if data.get("sha256") == sha256 else []
    return used


def _held_out(values: Mapping[str, Any]) -> tuple[float, int]:
    return float(values.get("holdback", 0.0)), int(values.get("fold", 0))
