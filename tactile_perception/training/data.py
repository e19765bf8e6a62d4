"""What a training run begins with, in memory: training, held-out and validation samples, and its start."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from tactile_base.input_file import parse_json, read_text
from tactile_base.settings import SettingError
from tactile_perception.datasets.dataset import (
    DatasetError,
    TactileDataset,
    read_dataset,
    read_rows,
    training_part,
)
from tactile_perception.datasets.layout import is_sharded, parts_of
from tactile_perception.datasets.shards import ShardedFolder, open_shards
from tactile_perception.estimating.contact_model import CONTACT_MODELS, SURFACE, ContactModel
from tactile_perception.estimating.image import Image
from tactile_perception.estimating.labels import EULER_COMPONENTS
from tactile_perception.estimating.model_metadata import split_holdback
from tactile_perception.estimating.preprocessing import PreprocessingSettings
from tactile_perception.evaluation.calibration import CalibrationError
from tactile_perception.training.augmentation import SCALE
from tactile_perception.training.config import TrainConfig
from tactile_perception.training.feed import Feed, MemoryFeed, ShardFeed, spread_rows
from tactile_perception.training.marker_field import MarkerFields
from tactile_perception.training.run_folder import BEST_NAME, CONFIG_NAME, FACTS_NAME, RunFolder
from tactile_perception.training.settings import NetworkSettings

#: Of the facts: what the network tells, where that is not a surface with all labels.
_MODEL = "contact_model"
#: One sample has no deviation to start from.
_FEWEST_SAMPLES = 2
#: Standard deviations (6,) in mm and degrees of labels that vary by an arm's errors alone; of the depth in mm
#: from which labels are in those units.
_IDLE, _MOVING = np.repeat([0.1, 0.2], 3), 0.3
#: Settings in which networks of a run and its start may differ; all others decide which weights there are.
_FREE = {
    "head",
    "batch_norm_momentum",
    "dropout_mean",
    "dropout_inverse_sigma",
    "dropout_correlation",
    "mse_weights",
    "redraw_radius",
}


#: Rows to train on, and rows held out.
Split = tuple[NDArray[np.int64], NDArray[np.int64]]


@dataclass(frozen=True)
class Samples:
    """Images uint8 (N, size, size) and labels float64 (N, K) in mm, rad and N; NaN: not labelled."""

    images: Image
    labels: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.images)

    def taken(self, chosen: NDArray[np.int64]) -> Samples:
        return Samples(self.images[chosen], self.labels[chosen])


@dataclass(frozen=True)
class RunData:
    """All that a run reads.

    Attributes
    ----------
    training, held_out, validation : at the network's input size; `held_out` may be empty
    large : the training images at SCALE times that size, for augmentation; None without it
    preprocessing : how images become inputs of the network
    facts : number of samples and hashes, for the model's metadata
    report : lines on what was found in the folders
    model : what the network is to tell, and what of it the training data label
    start : the network to start from; None: random weights
    reference : the image without contact, where images are compared with it
    rest : as one of `large`, without contact, where there is one
    fields : of the markers in the training images, where the network finds them
    streamed : all training samples, where `training` and `large` are some of them only
    """

    training: Samples
    held_out: Samples
    validation: Samples
    large: Image | None
    preprocessing: PreprocessingSettings
    facts: dict[str, Any]
    report: list[str]
    model: ContactModel = SURFACE
    start: Start | None = None
    reference: Image | None = None
    rest: Image | None = None
    fields: MarkerFields | None = None
    streamed: ShardFeed | None = None

    @property
    def feed(self) -> Feed:
        """Where a run's batches come from."""
        images = self.training.images if self.large is None else self.large
        return self.streamed or MemoryFeed(images, self.training.labels)

    def started(self, start: Start | None) -> RunData:
        """With the network to start from; `SettingError` if it takes images of other colors."""
        if start is None:
            return self
        start.check_channels(self.preprocessing.channels)
        if start.facts.get(_MODEL) != self.facts.get(_MODEL):
            start = start.without_head()
        # what the start has learned from, the new network will have seen as well
        return dataclasses.replace(self, start=start, facts={**self.facts, "start": start.facts})


def load_data(
    data_dir: Path,
    validation_dir: Path | str | None,
    config: TrainConfig,
    limit: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    following: Callable[[int, int], None] | None = None,
) -> RunData:
    """Read the folders; `DatasetError` if they cannot be used or do not fit together."""
    train_dir, validation_dir = data_folders(data_dir, validation_dir, config)
    network, run = config.network, config.training.start
    start = load_start(run, network) if run else None  # before the images: it may be refused
    CONTACT_MODELS.load(config.training.model)
    changes = {"size": network.image_size, "redraw_radius": network.redraw_radius}
    scale = SCALE if config.augmentation.active else 1
    large = {**changes, "size": scale * network.image_size}
    streamed = _beyond_memory(train_dir, large, config) if limit is None else None
    if streamed is None:
        training = read_dataset(train_dir, changes=large, limit=limit, progress=progress, complete=False)
        split = None
    else:
        whole = split_holdback(len(streamed), config.training.holdback, config.training.fold)
        training, split = _read_some(streamed, whole, progress)
    validation = (
        _validation(validation_dir, changes, config, progress) if validation_dir is not None else None
    )
    preprocessing = training.preprocessing.replaced(**changes)
    if validation is not None and preprocessing != validation.preprocessing:
        raise DatasetError(
            f"{train_dir} and {validation_dir} were pre-processed differently: the first has "
            f"{preprocessing.differences(validation.preprocessing)}"
        )
    data = arrange(training, validation, config, preprocessing, following, split).started(start)
    return data if streamed is None else _streaming(data, streamed, whole)


def _validation(
    folder: Path | str,
    changes: dict[str, Any],
    config: TrainConfig,
    progress: Callable[[int, int], None] | None,
) -> TactileDataset:
    """All samples of a folder, or some of those that no memory holds."""
    beyond = _beyond_memory(Path(folder), changes, config)
    if beyond is None:
        return read_dataset(folder, changes=changes, progress=progress, complete=False)
    return _read_some(beyond, (np.arange(len(beyond)), np.arange(0)), progress)[0]


def _beyond_memory(folder: Path, changes: dict[str, Any], config: TrainConfig) -> ShardedFolder | None:
    """The shards of a folder whose images need more memory than they may."""
    if not is_sharded(folder):
        return None
    source = open_shards(folder)
    source.preprocessing = settings = source.preprocessing.replaced(**changes)
    needed = len(source) * settings.size**2 * settings.channels / 2**30
    return source if needed > config.training.images_in_memory else None


def _read_some(
    source: ShardedFolder, split: Split, progress: Callable[[int, int], None] | None
) -> tuple[TactileDataset, Split]:
    """Some samples of both parts of a split, and which of them are of which part."""
    parts = [spread_rows(source, rows) for rows in split]
    rows = np.union1d(*parts)
    data = read_rows(source, rows, progress)
    if len(data) != len(rows):
        raise DatasetError("\n".join([f"{source.folder}: unusable images", *data.report.lines()]))
    data.report.notes.append(f"of {len(source)} samples in shards {len(rows)} are in memory")
    return data, (np.searchsorted(rows, parts[0]), np.searchsorted(rows, parts[1]))


def _streaming(data: RunData, source: ShardedFolder, whole: Split) -> RunData:
    """A run on the shards, of which `data` has some samples in memory."""
    kept, held_out = whole
    labels = data.model.labels(source.euler_mm_deg[kept], source.force[kept], data.model.labelled)
    fields = data.fields
    if fields is not None:
        fields = fields.among(len(kept), np.searchsorted(kept, spread_rows(source, kept)))
    counts = {"samples": len(kept), "held_out": len(held_out)}
    facts = {**data.facts, **counts, "sha256": source.sha256, "streamed": True}
    return dataclasses.replace(data, streamed=ShardFeed(source, kept, labels), fields=fields, facts=facts)


def arrange(
    training: TactileDataset,
    validation: TactileDataset | None,
    config: TrainConfig,
    preprocessing: PreprocessingSettings,
    following: Callable[[int, int], None] | None = None,
    split: Split | None = None,
) -> RunData:
    """Hold samples back and reduce images to the network's size where that is still to be done.

    Where the network is to find the markers' field, they are followed in the training images. Without data to
    validate on, what is held back does that as well. `split`: rows to train on and rows held out, where that
    is decided.
    """
    named = CONTACT_MODELS.load(config.training.model)
    idle = _idle(training, named)
    training = _without(training, idle)
    model = named.narrowed(training.labelled, training.report.folder)
    kept, held_out = split or split_holdback(len(training), config.training.holdback, config.training.fold)
    large = training.images[kept] if config.augmentation.active else None
    samples = Samples(reduced(training.images, preprocessing.size), training.labels_for(model))
    facts = {
        "samples": len(kept),
        "held_out": len(held_out),
        "sha256": training.sha256,
    }
    report, validated = training.report.lines(), samples.taken(held_out)
    if validation is not None:
        validation = _without(validation, idle)
        named.narrowed(validation.labelled, validation.report.folder)
        facts |= {"validation_samples": len(validation), "validation_sha256": validation.sha256}
        report += validation.report.lines()
        validated = Samples(validation.images, validation.labels_for(model))
    else:
        if config.training.choose == "loss":
            report.append(f"  note: the {len(held_out)} samples held out choose the epoch as well")
    if model != SURFACE:
        facts[_MODEL] = model.plain()
    if idle:
        report.append(f"  note: {', '.join(idle)} never change by more than an arm errs: as if not labelled")
    if model.unknown:
        report.append(f"  {model.says_unknown()}")
    if not (preprocessing.binary or config.augmentation.gain):
        report.append(
            "  note: images without a threshold have the levels of one day's light; augmentation.gain=0.15 "
            "makes a network know others"
        )
    fields = None
    if order := config.network.field_order:
        names = [training.names[i] for i in kept]
        fields = MarkerFields.of(training.report.folder, preprocessing.bbox[:2], order, names, following)
        report.append(f"  the markers of {fields.known.sum()} of {len(names)} images were followed")
    return RunData(
        training=samples.taken(kept),
        held_out=samples.taken(held_out),
        validation=validated,
        large=large,
        preprocessing=preprocessing,
        facts=facts,
        report=report,
        model=model,
        reference=training.reference,
        rest=training.rest,
        fields=fields,
    )


def _idle(data: TactileDataset, model: ContactModel) -> list[str]:
    """Components that were meant to stay as they are, so that labels of them are an arm's errors alone.

    A network would tell them with next to no deviation, and its loss be about nothing else. A whole pose is
    learned as one, and keeps them. Where depth does not change as in mm either, units are wrong.
    """
    deviations = data.euler_mm_deg.std(axis=0)
    if not model.turning or deviations[2] < _MOVING:
        return []
    small = dict(zip(EULER_COMPONENTS, deviations < _IDLE, strict=True))
    return [name for name in data.labelled if small.get(name) and name not in model.required]


def _without(data: TactileDataset, names: list[str]) -> TactileDataset:
    """The data set as if these were not labelled."""
    return dataclasses.replace(data, labelled=tuple(name for name in data.labelled if name not in names))


def check_samples(data: RunData, config: TrainConfig) -> None:
    """`DatasetError` or `CalibrationError` for too few samples to train on, or to calibrate on in the end.

    `SettingError` for an augmentation that would have to know more than is labelled.
    """
    _check_symmetry(data, config)
    if len(data.training) < _FEWEST_SAMPLES:
        raise DatasetError(f"training data: {len(data.training)} samples, needs at least {_FEWEST_SAMPLES}")
    held_out, needed = len(data.held_out), config.calibration.min_samples
    if 0 < held_out < needed and config.network.head != "mse":
        raise CalibrationError(
            f"training.holdback = {config.training.holdback:g} leaves {held_out} samples to calibrate on: "
            f"needs at least {needed} (calibration.min_samples); hold back more, or nothing, or "
            "train by few_contacts.yaml"
        )


def _check_symmetry(data: RunData, config: TrainConfig) -> None:
    """`SettingError` where images are not the same after a turn, or labels not known."""
    given, model = config.augmentation, data.model
    if given.copies == 1:
        return
    asked = f"augmentation.symmetry = {given.symmetry}" + ", mirror = true" * given.mirror
    without = "give --set augmentation.symmetry=1" + " --set augmentation.mirror=false" * given.mirror
    if not ((model.tangent or model.directed) and set(model.forces) <= set(model.labelled)):
        why = f"{', '.join(model.unknown)} not labelled" if model.unknown else f"this is '{model.name}'"
        raise SettingError(
            f"{asked}: turning a contact on a surface needs all components of its label ({why}); {without}"
        )
    if data.preprocessing.color:
        raise SettingError(
            f"{asked}: an image in color, lit from several sides, does not look the same after a turn; "
            f"{without}"
        )


def data_folders(
    data_dir: Path, validation_dir: Path | str | None, config: TrainConfig
) -> tuple[Path, Path | None]:
    """Training and validation folder; None where what is held out of the first does for the second."""
    if not data_dir.is_dir():
        raise DatasetError(f"{data_dir}: there is no such folder")
    train_dir, parts = training_part(data_dir), parts_of(data_dir)
    if validation_dir is not None:
        return train_dir, Path(validation_dir)
    if "train" in parts and "val" in parts:
        return train_dir, parts["val"]
    if config.training.holdback > 0.0:
        return train_dir, None
    raise DatasetError(
        f"{data_dir}: holds no train/ and val/; name the validation data with --val, or hold some back "
        "(--set training.holdback=0.2)"
    )


def reduced(images: Image, size: int) -> Image:
    """Images (N, side, side[, 3]) at `size` pixels."""
    if images.shape[1] == size:
        return images
    shape = (size, size)
    return np.stack([cv2.resize(image, shape, interpolation=cv2.INTER_AREA) for image in images])


@dataclass(frozen=True)
class Start:
    """Weights of a finished run, without its head's if that is of another kind; and what they come from."""

    weights: dict[str, Tensor]
    facts: dict[str, Any]

    def without_head(self) -> Start:
        """For a network that tells something else."""
        weights = {name: value for name, value in self.weights.items() if not name.startswith("head.")}
        return dataclasses.replace(self, weights=weights)

    def check_channels(self, channels: int) -> None:
        """`SettingError` unless it was trained on images of so many colors."""
        own = next(weight for weight in self.weights.values() if weight.ndim == 4).shape[
            1
        ]  # the first convolution
        if (own % 3 == 0) != (channels == 3):
            colors = ("gray", "color") if channels == 3 else ("color", "gray")
            raise SettingError(
                f"training.start: its network takes {colors[0]} images, these are in {colors[1]}"
            )

    def give(self, network: nn.Module) -> None:
        """Put the weights into a network; what they lack stays as it is."""
        network.load_state_dict({**network.state_dict(), **self.weights})


def load_start(run: Path | str, network: NetworkSettings) -> Start:
    """The best network of a finished run of `tactile train`, for a run whose network has these settings.

    Raises `SettingError` if the folder holds no finished run, or one of another network; the message says
    what differs.
    """
    folder = RunFolder(run)
    if not folder.finished:
        raise SettingError(f"training.start = {run}: is not the folder of a finished run of `tactile train`")
    if not folder.file(BEST_NAME).exists():
        raise SettingError(f"training.start = {run}: is of several networks; take one, as {run}/fold_0")
    config = TrainConfig.from_file(folder.file(CONFIG_NAME))
    for name in NetworkSettings.__dataclass_fields__:
        theirs, ours = getattr(config.network, name), getattr(network, name)
        if name not in _FREE and theirs != ours:
            raise SettingError(
                f"training.start = {run}: its network has {name} = {theirs}, this one {ours}; they must agree"
            )
    facts = parse_json(read_text(folder.file(FACTS_NAME)))
    facts |= {"holdback": config.training.holdback, "fold": config.training.fold}
    facts["weights_sha256"] = hashlib.sha256(folder.file(BEST_NAME).read_bytes()).hexdigest()
    start = Start(folder.load_best(), facts)
    return start if config.network.head == network.head else start.without_head()
