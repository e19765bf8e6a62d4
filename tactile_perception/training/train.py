"""Training of a pose network on a data folder, from images to the model file."""

from __future__ import annotations

import ctypes
import dataclasses
import math
import time
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from tactile_perception.estimating.image import Image
from tactile_perception.estimating.layout import Layout
from tactile_perception.estimating.model_metadata import MODEL_NAME, ModelMetadata
from tactile_perception.estimating.novelty import Novelty
from tactile_perception.estimating.plain_depth import PlainDepth
from tactile_perception.estimating.preprocessing import MID_GRAY
from tactile_perception.evaluation.calibration import Calibration, fit_calibration
from tactile_perception.training.augmentation import Augmenter
from tactile_perception.training.config import TrainConfig
from tactile_perception.training.data import RunData, Samples, check_samples, load_data, reduced
from tactile_perception.training.export import export_onnx
from tactile_perception.training.loss import StepLoss
from tactile_perception.training.network import PoseNetwork, WeightAverage
from tactile_perception.training.processes import Processes
from tactile_perception.training.progress import TimeLeft, TrainingProgress
from tactile_perception.training.registration import FieldTargets, Registration
from tactile_perception.training.run_folder import Epoch, RunFolder, TrainResult
from tactile_perception.training.settings import learning_rate
from tactile_perception.training.symmetry import SymmetryAxis

__all__ = ["Epoch", "TrainConfig", "TrainResult", "TrainingProgress", "train"]
_EVALUATION_BATCH = 100
_BF16 = {"amx_bf16", "avx512_bf16", "bf16"}  # of x86, and of ARM


def train(
    data_dir: Path | str,
    out_dir: Path | str,
    config: TrainConfig | None = None,
    validation_dir: Path | str | None = None,
    limit: int | None = None,
    progress: TrainingProgress | None = None,
) -> TrainResult:
    """Train on a folder of the public layout and leave everything about the run in `out_dir`.

    A run that was interrupted goes on where its last whole epoch ended, when it is asked for again with the
    same configuration and data, and ends as it would have without the interruption. `FileExistsError` if
    `out_dir` holds a finished run, or one with another configuration or other data; `DatasetError`,
    `SettingError`, `AugmentationError` or `CalibrationError` for unusable data or configuration.

    Parameters
    ----------
    data_dir : training data, or a folder that holds `train/` and `val/`
    out_dir : gets `config.yaml`, `data.txt` (what was found in the folders) and `data.json` (their hashes),
        `epochs.csv`, `curves.png`, `best.pt`, `model.onnx` and, at the very end, `result.json`
    validation_dir : validation data; without, and without `val/` in `data_dir`, what is held back
    limit : use this many training samples only
    """
    config = config or TrainConfig()
    progress = progress or TrainingProgress()
    folder = RunFolder(out_dir)
    folder.check_free()  # before the images are read
    with Processes() as processes:
        if not processes.first:
            progress = TrainingProgress()
        data = load_data(Path(data_dir), validation_dir, config, limit, progress.loading, progress.following)
        return train_network(data, folder, config, progress, processes)


def train_network(
    data: RunData,
    folder: RunFolder,
    config: TrainConfig,
    progress: TrainingProgress,
    processes: Processes | None = None,
) -> TrainResult:
    """Train on data that have been read, from the start or from the state in the run folder.

    Where several processes train together, the first writes to the folder.
    """
    # What cannot be trained is refused here, before anything is written that would be in the way of another.
    check_samples(data, config)
    processes = processes or Processes()
    run = _Run(data, config, processes)
    first, settings = processes.first, config.training
    resume = first and folder.open(config, data.facts, data.report)
    state = processes.told(folder.load_state() if resume else None)
    history = run.restore(state) if state is not None else _History()
    remaining = TimeLeft(settings.epochs, run.steps_per_epoch, settings.batch_size, len(data.validation))
    progress.learning(data.model)
    progress.start(settings.epochs, run.steps_per_epoch, run.loss_name, len(history.epochs))
    while history.stopped is None:
        number = len(history.epochs)
        epoch, weights = run.epoch(number, history.best, progress, remaining)
        history.add(epoch, settings.epochs, settings.patience, settings.max_minutes)
        if not run.usable:
            history.stopped = "the network's weights were not finite any more"
        if first:
            if epoch.best:
                folder.save_best(weights)
            folder.write_epochs(history.epochs, run.loss_name, data.model.columns)
            folder.save_state(run.state(history))
        progress.epoch(epoch)
    if history.best is None:
        raise FloatingPointError(
            f"the validation loss was never finite: lower the learning rate (stopped: {history.stopped})"
        )
    model_path = folder.file(MODEL_NAME)
    result = TrainResult(model_path, history.best, history.epochs, history.stopped, history.minutes)
    if first:
        folder.finish(result, run.loss_name, run.finish(folder, history.best), data.model)
    processes.told(None)  # that it is finished
    return result


@dataclass
class _History:
    """What became of each epoch, and why there are no more."""

    epochs: list[Epoch] = field(default_factory=list)
    best: Epoch | None = None
    stopped: str | None = None

    @property
    def minutes(self) -> float:
        return sum(epoch.seconds for epoch in self.epochs) / 60.0

    def add(self, epoch: Epoch, epochs: int, patience: int, max_minutes: float) -> None:
        """Append an epoch and decide whether it was the last."""
        self.epochs.append(epoch)
        if epoch.best:
            self.best = epoch
        since_best = epoch.number - self.best.number if self.best else epoch.number + 1
        if epoch.number + 1 >= epochs:
            self.stopped = "end of the schedule"
        elif since_best >= patience:
            self.stopped = f"no better validation loss in {patience} epochs"
        elif max_minutes and self.minutes + epoch.seconds / 60.0 > max_minutes:
            self.stopped = f"time limit of {max_minutes:g} min"


class _Run:
    """Network, optimizer and data of one run."""

    def __init__(self, data: RunData, config: TrainConfig, processes: Processes) -> None:
        settings = config.training
        self.feed = data.feed
        processes.share(settings.batch_size, len(self.feed.labels))  # is one, or refused
        torch.manual_seed(settings.seed)
        if settings.threads:
            torch.set_num_threads(settings.threads)
        keep_freed_memory()
        self.config, self.data, self.processes = config, data, processes
        self.device = processes.device
        self.low_precision = in_low_precision(settings.precision, self.device)
        self.layout = torch.channels_last if settings.channels_last else torch.contiguous_format
        self.network = PoseNetwork(config.network, data.model, data.preprocessing.channels)
        self.loss_name = self.network.distribution.name
        labels = torch.from_numpy(self.feed.labels.astype(np.float32))
        self.network.start_from(labels)
        if data.start is not None:
            data.start.give(self.network)
        self.axis: SymmetryAxis | None = None
        self.augmenter = self._augmenter()
        fields = self._place_fields()
        self.network.to(self.device).to(memory_format=self.layout)  # type: ignore[call-overload]
        self.optimizer = self._optimizer()
        self.average = WeightAverage(self.network, settings.average_decay)
        self.loss = StepLoss(
            self.network, self.axis, fields, labels.to(self.device), settings, self.low_precision
        )
        self.joined = processes.joined(self.loss, partly_used=self.axis is not None)
        steps_per_pass = self.feed.steps(settings.batch_size, processes)
        self.passes = max(1, math.ceil(settings.least_steps / (settings.epochs * steps_per_pass)))
        self.steps_per_epoch = self.passes * steps_per_pass

    def epoch(
        self, number: int, best: Epoch | None, progress: TrainingProgress, remaining: TimeLeft
    ) -> tuple[Epoch, dict[str, Tensor]]:
        """Training data, each sample once or more often, and a validation; epoch and validated weights.

        The first process validates; the others have no weights from it.
        """
        started = time.monotonic()
        train_loss = self._train_epoch(number, progress, remaining)
        if not self.processes.first:
            return self.processes.told(None), {}  # type: ignore[return-value]
        trained = time.monotonic()
        with self.average.in_place():
            validation_loss, mae = self.evaluate(self.data.validation, self.low_precision)
            weights = {name: value.cpu().clone() for name, value in self.network.state_dict().items()}
        better = np.isfinite(validation_loss) and (
            self.config.training.choose == "last" or best is None or validation_loss < best.validation_loss
        )
        rate = learning_rate(number + 1.0, self.config.training)
        ended = time.monotonic()
        remaining.validation(ended - trained)
        left = remaining.seconds(number + 1) or 0.0
        epoch = Epoch(number, rate, train_loss, validation_loss, mae, ended - started, bool(better), left)
        return self.processes.told(epoch), weights

    def _train_epoch(self, number: int, progress: TrainingProgress, remaining: TimeLeft) -> float:
        settings = self.config.training
        # Every epoch has random numbers of its own, so that a resumed run draws those of a whole one.
        torch.manual_seed(int(np.random.SeedSequence([settings.seed, number]).generate_state(1)[0]))
        order = rng = np.random.default_rng([settings.seed, number])
        if self.processes.count > 1:  # one order for all, but dropout and augmentation of their own
            rng = np.random.default_rng([settings.seed, number, self.processes.rank])
            torch.manual_seed(int(rng.integers(2**62)))
        batches = chain.from_iterable(
            self.feed.batches(settings.batch_size, order, self.processes) for _ in range(self.passes)
        )
        self.network.train()
        if settings.frozen == "base":
            self.network.base.eval()  # statistics of its normalization, too
        total = 0.0
        before = time.monotonic()
        for step in range(self.steps_per_epoch):
            moment = number + step / self.steps_per_epoch
            for group in self.optimizer.param_groups:
                group["lr"] = learning_rate(moment, settings) * group["factor"]
            rows, images = next(batches)
            loss = self._step(rows, images, moment, rng)
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
            self.optimizer.step()
            self.average.update()
            total += loss.item()
            now = time.monotonic()
            remaining.step(now - before)
            before = now
            progress.step(number, step, total / (step + 1), remaining.seconds(number, step + 1))
        return self.processes.mean(total / self.steps_per_epoch)

    @property
    def usable(self) -> bool:
        """Whether all weights are finite; once one is not, no step brings it back."""
        return all(bool(torch.isfinite(weight).all()) for weight in self.network.parameters())

    def _step(
        self, rows: NDArray[np.int64], images: Image, moment: float, rng: np.random.Generator
    ) -> Tensor:
        """Loss on some samples, augmented where that is asked for."""
        settings, turns = self.config.augmentation, np.zeros(len(rows), np.int64)
        augmented = moment < self.config.training.epochs - settings.plain_epochs
        if self.augmenter is not None and augmented:
            images, turns = self.augmenter(images, rng)
        else:
            images = reduced(images, self.config.network.image_size)
        drawn = self.loss.draw(settings.copies if augmented else 1, rng)
        inputs, samples = (torch.from_numpy(array).to(self.device) for array in (images, rows))
        loss: Tensor = self.joined(self._input(inputs), samples, turns, drawn)
        return loss

    def _place_fields(self) -> FieldTargets | None:
        """What the network's base is to find; its disc and scale come from there."""
        base, fields = self.network.base, self.data.fields
        if fields is None:
            return None
        assert isinstance(base, Registration)
        copies = np.eye(2)[None] if self.augmenter is None else self.augmenter.copies
        base.place(fields, self.data.preprocessing.crop_shape, copies)
        return FieldTargets(fields, base, copies, self.device)

    def evaluate(self, samples: Samples, low_precision: bool = False) -> tuple[float, NDArray[np.float64]]:
        """Loss and MAE (K,) of the network as it is; NaN where nothing is labelled."""
        raw, head = self.answers(samples, low_precision), self.network.distribution
        labels = torch.from_numpy(samples.labels.astype(np.float32))
        error, labelled = head.error(labels, head.mean(raw))
        mae = error.abs().double().sum(dim=0) / labelled.double().sum(dim=0)
        return head.loss(labels, raw).item(), mae.numpy()

    @torch.inference_mode()
    def answers(self, samples: Samples, low_precision: bool = False) -> Tensor:
        """Raw outputs (N, outputs) for all samples, on the CPU."""
        self.network.eval()
        parts = []
        for start in range(0, len(samples), _EVALUATION_BATCH):
            images = torch.from_numpy(samples.images[start : start + _EVALUATION_BATCH]).to(self.device)
            with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=low_precision):
                parts.append(self.network(self._input(images)).cpu())
        return torch.cat(parts)

    def finish(self, folder: RunFolder, best: Epoch) -> dict[str, Any]:
        """Export the best epoch's network, calibrated on what was held out; its facts on validation data."""
        self.network.load_state_dict(folder.load_best())
        loss, mae = self.evaluate(self.data.validation)
        model = self.data.model
        errors = {
            name: value for name, value in zip(model.names, mae.tolist(), strict=True) if value == value
        }
        validation = {"validation_loss": loss, "mae": errors}
        training: dict[str, Any] = self.config.plain()
        training["training"]["precision"] = "bf16" if self.low_precision else "fp32"
        if self.axis is not None:
            training["symmetry_axis_found"] = self.axis.parameters_of_axis()
        calibration = self._calibration()
        metadata = ModelMetadata(
            preprocessing=self.data.preprocessing,
            training_data=self.data.facts,
            validation={"loss": self.loss_name, **validation, "epoch": best.number + 1},
            training=training,
            calibration=calibration,
            layout=None if self.data.preprocessing.difference else Layout.of(self.data.training.images),
            plain_depth=PlainDepth.fit(self.data.training.images, model.depths(self.data.training.labels)),
            novelty=Novelty.fit(self.data.training.images, self._tolerated_light()),
            reference=self.data.reference,
            contact_model=model,
        )
        sigma = self._constant_sigma()
        self.network.to("cpu")
        export_onnx(self.network, folder.file(MODEL_NAME), metadata, sigma)
        return validation

    def _tolerated_light(self) -> float:
        """What the network has borne in training of a change of light; infinite behind a threshold."""
        return math.inf if self.data.preprocessing.binary else 2.0 * self.config.augmentation.gain

    def _calibration(self) -> Calibration:
        """Fitted on the held-out samples; the identity where there are none or no uncertainty."""
        held_out = self.data.held_out
        if not len(held_out) or self.config.network.head == "mse":
            return Calibration()
        raw = self.answers(held_out)
        head = self.network.distribution
        mean, covariance = head.mean(raw).double().numpy(), head.covariance(raw).double().numpy()
        error = self.data.model.error(mean, held_out.labels)
        return fit_calibration(held_out.labels, mean, covariance, self.config.calibration, error)

    def _constant_sigma(self) -> NDArray[np.float64] | None:
        """RMS errors (K,) of a network without uncertainty, on held-out or else on validation data."""
        if self.config.network.head != "mse":
            return None
        samples = self.data.held_out if len(self.data.held_out) else self.data.validation
        mean = self.network.distribution.mean(self.answers(samples)).double().numpy()
        model = self.data.model
        squared = model.error(mean, samples.labels) ** 2
        known = np.isfinite(squared)
        count = known.sum(axis=0)
        total = np.where(known, squared, 0.0).sum(axis=0)
        return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), model.prior[1])

    def state(self, history: _History) -> dict[str, Any]:
        """All that decides how the run goes on, in plain values and tensors."""
        return {
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "average": self.average.state(),
            "axis": self.axis.state_dict() if self.axis is not None else None,
            "epochs": [
                {name: np.asarray(value).tolist() for name, value in dataclasses.asdict(epoch).items()}
                for epoch in history.epochs
            ],
            "stopped": history.stopped,
        }

    def restore(self, state: dict[str, Any]) -> _History:
        """The reverse; returns the epochs so far."""
        self.network.load_state_dict(state["network"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.average.restore(state["average"])
        if self.axis is not None:
            self.axis.load_state_dict(state["axis"])
        epochs = [Epoch(**{**epoch, "mae": np.array(epoch["mae"])}) for epoch in state["epochs"]]
        best = next((epoch for epoch in reversed(epochs) if epoch.best), None)
        return _History(epochs, best, state["stopped"])

    def _optimizer(self) -> torch.optim.Adam:
        learning: dict[str, tuple[type, ...]] = {
            "nothing": (nn.Module,),
            "convolutions": (nn.BatchNorm2d,),
            "base": (),
        }
        for module in self.network.base.modules():
            for parameter in module.parameters(recurse=False):
                parameter.requires_grad_(isinstance(module, learning[self.config.training.frozen]))
        parameters = [value for value in self.network.parameters() if value.requires_grad]
        groups = [{"params": parameters, "factor": 1.0}]
        axis_rate = self.config.augmentation.symmetry_axis_rate
        if self.axis is not None and axis_rate > 0.0:
            groups.append({"params": [self.axis.values], "factor": axis_rate})
        return torch.optim.Adam(groups, lr=self.config.training.learning_rate_start, fused=True)

    def _augmenter(self) -> Augmenter | None:
        settings, data = self.config.augmentation, self.data
        if data.large is None:
            return None
        depth, labels = data.model.depths(data.training.labels), data.training.labels
        dark = MID_GRAY if data.preprocessing.difference else 0.0
        augmenter = Augmenter(data.large, depth, data.preprocessing.crop_shape, settings, dark, data.rest)
        if settings.copies > 1:
            self.axis = augmenter.axis(data.large, labels, data.model.directed)
            self.axis.to(self.device)
        return augmenter

    def _input(self, images: Tensor) -> Tensor:
        """uint8 (N, size, size) or (N, size, size, 3) -> float (N, channels, size, size) in [0, 1]."""
        images = images.unsqueeze(1) if images.ndim == 3 else images.movedim(-1, 1)
        return images.to(torch.float32).mul_(1.0 / 255.0).contiguous(memory_format=self.layout)


def in_low_precision(precision: str, device: torch.device) -> bool:
    """Whether to compute in bf16: where it is asked for, or by "auto" where the device has it.

    A processor without it imitates it: then an epoch takes seven times as long as in fp32 (AVX2 alone).
    """
    if precision != "auto":
        return precision == "bf16"
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device)[0] >= 8
    try:
        flags = Path("/proc/cpuinfo").read_text()
    except OSError:
        return False
    return not _BF16.isdisjoint(flags.split())


def keep_freed_memory() -> None:
    """Let glibc keep freed blocks instead of giving their pages back after every step.

    The activations of a step come to tens of megabytes; mapping them afresh each time cost 15 % of an epoch.
    Where the C library is another one, nothing happens.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return
    trim_threshold, mmap_threshold = -1, -3
    mallopt(trim_threshold, 2**31 - 1)
    mallopt(mmap_threshold, 32 * 2**20)
