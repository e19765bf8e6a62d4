"""Training of a Gaussian density network on a data folder: the loop, its run folder, its progress."""

from __future__ import annotations

import ctypes
import dataclasses
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from torch import Tensor

from tactile_filter.settings import SettingError, unknown_name
from tactile_filter.yaml_file import read_yaml
from tactile_perception.command_settings import name_and_value
from tactile_perception.dataset import DatasetError, TactileDataset, read_dataset
from tactile_perception.labels import COMPONENTS, NETWORK_UNITS
from tactile_perception.model_metadata import ModelMetadata
from tactile_perception.training.export import export_onnx
from tactile_perception.training.gdn import Gdn, mean_nll
from tactile_perception.training.settings import GdnSettings, TrainingSettings, learning_rate

SECTIONS = ("network", "training")
_EVALUATION_BATCH = 100


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides a run, as in a file of `config/perception/`."""

    network: GdnSettings = dataclasses.field(default_factory=GdnSettings)
    training: TrainingSettings = dataclasses.field(default_factory=TrainingSettings)

    @classmethod
    def from_file(cls, path: Path | str) -> TrainConfig:
        """From a YAML file's sections; `SettingError` names file, line and what would be right."""
        root = read_yaml(path)
        root.allow(*SECTIONS)
        return cls(root.settings("network", GdnSettings), root.settings("training", TrainingSettings))

    def changed(self, changes: Iterable[str]) -> TrainConfig:
        """A copy with settings changed by texts of the form section.name=value, as training.batch_size=32."""
        config = self
        for change in changes:
            name, value = name_and_value(change, "training.batch_size=32")
            section, _, key = name.partition(".")
            if section not in SECTIONS:
                raise SettingError(f"--set {change}: {unknown_name(section, SECTIONS)}")
            settings = getattr(config, section).replaced(**{key: value})
            config = dataclasses.replace(config, **{section: settings})
        return config


@dataclass(frozen=True)
class Epoch:
    """Result of one epoch; `mae` (6,) in mm and rad on the validation data."""

    number: int
    learning_rate: float
    train_loss: float
    validation_loss: float
    mae: NDArray[np.float64]
    seconds: float
    best: bool


@dataclass(frozen=True)
class TrainResult:
    """Result of a run: the best epoch's model and what became of each epoch."""

    model_path: Path
    best: Epoch
    epochs: list[Epoch]
    stopped: str
    minutes: float


class Progress:
    """What a run tells while it goes on; this one says nothing. `console.TrainingProgress` shows it."""

    def start(self, epochs: int, steps: int) -> None: ...

    def step(self, epoch: int, step: int, loss: float) -> None: ...

    def epoch(self, epoch: Epoch) -> None: ...


def train(
    data_dir: Path | str,
    out_dir: Path | str,
    config: TrainConfig | None = None,
    validation_dir: Path | str | None = None,
    limit: int | None = None,
    progress: Progress | None = None,
    loading: Callable[[int, int], None] | None = None,
) -> TrainResult:
    """Train on a folder of the public layout and leave everything about the run in `out_dir`.

    Parameters
    ----------
    data_dir : path
        Training data, or a folder that holds `train/` and `val/`.
    out_dir : path
        Gets `config.yaml`, `data.txt`, `epochs.csv`, `curves.png`, `best.pt` and `model.onnx`.
    validation_dir : path, optional
        Validation data; required unless `data_dir` holds `val/`.
    limit : int, optional
        Use this many training samples only.

    Returns
    -------
    TrainResult

    Raises
    ------
    DatasetError, SettingError
        Unusable data or configuration.
    FileExistsError
        If `out_dir` holds another run.
    """
    config = config or TrainConfig()
    train_dir, validation_dir = _data_folders(Path(data_dir), validation_dir)
    out_dir = _new_run_folder(Path(out_dir))
    size = config.network.image_size
    training = read_dataset(train_dir, size=size, limit=limit, progress=loading)
    validation = read_dataset(validation_dir, size=size, progress=loading)
    if training.preprocessing != validation.preprocessing:
        raise DatasetError(
            f"{train_dir} and {validation_dir} were pre-processed differently: "
            f"{training.preprocessing} and {validation.preprocessing}"
        )
    (out_dir / "config.yaml").write_text(yaml.safe_dump(_plain(config), sort_keys=False))
    (out_dir / "data.txt").write_text("\n".join(training.report.lines() + validation.report.lines()) + "\n")
    return train_network(training, validation, out_dir, config, progress or Progress())


def train_network(
    training: TactileDataset,
    validation: TactileDataset,
    out_dir: Path,
    config: TrainConfig,
    progress: Progress,
) -> TrainResult:
    """Train on data in memory; the part of `train` after loading."""
    run = _Run(training, validation, out_dir, config)
    settings = config.training
    started = time.monotonic()
    progress.start(settings.epochs, run.steps_per_epoch)
    epochs: list[Epoch] = []
    best: Epoch | None = None
    stopped = "end of the schedule"
    for number in range(settings.epochs):
        epoch = run.epoch(number, best, progress)
        epochs.append(epoch)
        if epoch.best:
            best = epoch
            torch.save(run.network.state_dict(), out_dir / "best.pt")
        _write_epochs(out_dir, epochs)
        progress.epoch(epoch)
        assert best is not None
        minutes = (time.monotonic() - started) / 60.0
        if number - best.number >= settings.patience:
            stopped = f"no better validation loss in {settings.patience} epochs"
            break
        if settings.max_minutes and minutes + epoch.seconds / 60.0 > settings.max_minutes:
            stopped = f"time limit of {settings.max_minutes:g} min"
            break
    if best is None:
        raise FloatingPointError("the validation loss was never finite: lower the learning rate")
    model_path = run.export(best)
    _draw_curves(out_dir / "curves.png", epochs)
    return TrainResult(model_path, best, epochs, stopped, (time.monotonic() - started) / 60.0)


class _Run:
    """Network, optimizer and data of one run."""

    def __init__(
        self, training: TactileDataset, validation: TactileDataset, out_dir: Path, config: TrainConfig
    ):
        settings = config.training
        torch.manual_seed(settings.seed)
        if settings.threads:
            torch.set_num_threads(settings.threads)
        keep_freed_memory()
        self.config, self.out_dir = config, out_dir
        self.training, self.validation = training, validation
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.layout = torch.channels_last if settings.channels_last else torch.contiguous_format
        self.network = Gdn(config.network)
        self.images, self.labels = self._tensors(training)
        self.validation_images, self.validation_labels = self._tensors(validation)
        self.network.start_from(self.labels.cpu())
        self.network.to(self.device).to(memory_format=self.layout)  # type: ignore[call-overload]
        self.optimizer = torch.optim.Adam(
            self.network.parameters(), lr=settings.learning_rate_start, fused=True
        )
        self.shuffle = torch.Generator().manual_seed(settings.seed)
        # A last batch of one sample would leave batch normalization without a variance.
        self.steps_per_epoch = max(1, len(training) // settings.batch_size)

    def epoch(self, number: int, best: Epoch | None, progress: Progress) -> Epoch:
        started = time.monotonic()
        train_loss = self._train_epoch(number, progress)
        validation_loss, mae = self._evaluate()
        better = np.isfinite(validation_loss) and (best is None or validation_loss < best.validation_loss)
        rate = learning_rate(number + 1.0, self.config.training)
        seconds = time.monotonic() - started
        return Epoch(number, rate, train_loss, validation_loss, mae, seconds, bool(better))

    def _train_epoch(self, number: int, progress: Progress) -> float:
        settings = self.config.training
        self.network.train()
        order = torch.randperm(len(self.training), generator=self.shuffle)
        total = 0.0
        for step in range(self.steps_per_epoch):
            chosen = order[step * settings.batch_size : (step + 1) * settings.batch_size].to(self.device)
            rate = learning_rate(number + step / self.steps_per_epoch, settings)
            for group in self.optimizer.param_groups:
                group["lr"] = rate
            loss = self._loss(self.images[chosen], self.labels[chosen])
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
            self.optimizer.step()
            total += loss.item()
            progress.step(number, step, total / (step + 1))
        return total / self.steps_per_epoch

    def _loss(self, images: Tensor, labels: Tensor) -> Tensor:
        enabled = self.config.training.precision == "bf16"
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=enabled):
            mean, inverse_sigma = self.network(self._input(images))
        return mean_nll(labels, mean, inverse_sigma)

    @torch.inference_mode()
    def _evaluate(self) -> tuple[float, NDArray[np.float64]]:
        """Validation loss and MAE (6,), in full precision: what the exported model will give."""
        self.network.eval()
        losses, errors = [], []
        for start in range(0, len(self.validation), _EVALUATION_BATCH):
            labels = self.validation_labels[start : start + _EVALUATION_BATCH]
            mean, inverse_sigma = self.network(
                self._input(self.validation_images[start : start + _EVALUATION_BATCH])
            )
            losses.append(mean_nll(labels, mean, inverse_sigma).item() * len(labels))
            errors.append((mean - labels).abs().double().cpu().numpy())
        return sum(losses) / len(self.validation), np.concatenate(errors).mean(axis=0)

    def export(self, best: Epoch) -> Path:
        """The best epoch's network as `model.onnx` in the run folder."""
        state = torch.load(self.out_dir / "best.pt", map_location="cpu", weights_only=True)
        self.network.to("cpu").load_state_dict(state)
        self.network.eval()
        metadata = ModelMetadata(
            preprocessing=self.training.preprocessing,
            training_data={
                "samples": len(self.training),
                "sha256": self.training.sha256,
                "validation_samples": len(self.validation),
                "validation_sha256": self.validation.sha256,
            },
            validation={
                "mean_nll": best.validation_loss,
                "mae": dict(zip(COMPONENTS, best.mae.tolist(), strict=True)),
                "epoch": best.number + 1,
            },
            training=_plain(self.config),
        )
        return export_onnx(self.network, self.out_dir / "model.onnx", metadata)

    def _tensors(self, data: TactileDataset) -> tuple[Tensor, Tensor]:
        images = torch.from_numpy(data.images).to(self.device)
        return images, torch.from_numpy(data.labels.astype(np.float32)).to(self.device)

    def _input(self, images: Tensor) -> Tensor:
        """uint8 (N, size, size) -> float (N, 1, size, size) in [0, 1]."""
        return images.unsqueeze(1).to(torch.float32).mul_(1.0 / 255.0).contiguous(memory_format=self.layout)


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


def _data_folders(data_dir: Path, validation_dir: Path | str | None) -> tuple[Path, Path]:
    train_dir = data_dir / "train" if (data_dir / "train").is_dir() else data_dir
    if validation_dir is not None:
        return train_dir, Path(validation_dir)
    if (data_dir / "train").is_dir() and (data_dir / "val").is_dir():
        return train_dir, data_dir / "val"
    raise DatasetError(f"{data_dir}: holds no train/ and val/; name the validation data with --val")


def _new_run_folder(out_dir: Path) -> Path:
    if (out_dir / "epochs.csv").exists():
        raise FileExistsError(f"{out_dir}: holds another run; remove it or choose another folder")
    out_dir.mkdir(parents=True, exist_ok=True)
    return out_dir


def _plain(config: TrainConfig) -> dict[str, Any]:
    """The configuration in types that YAML and JSON have."""
    sections = dataclasses.asdict(config)
    return {
        section: {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}
        for section, values in sections.items()
    }


def _write_epochs(out_dir: Path, epochs: list[Epoch]) -> None:
    units = [f"mae_{name}_{unit}" for name, unit in zip(COMPONENTS, NETWORK_UNITS, strict=True)]
    lines = [",".join(["epoch", "learning_rate", "train_nll", "validation_nll", *units, "seconds"])]
    for epoch in epochs:
        values = [epoch.learning_rate, epoch.train_loss, epoch.validation_loss, *epoch.mae, epoch.seconds]
        lines.append(",".join([str(epoch.number + 1), *(f"{value:.6g}" for value in values)]))
    (out_dir / "epochs.csv").write_text("\n".join(lines) + "\n")


def _draw_curves(path: Path, epochs: list[Epoch]) -> None:
    """Loss and MAE over the epochs."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    loss, translation, rotation = figure.subplots(1, 3)
    number = [epoch.number + 1 for epoch in epochs]
    loss.plot(number, [epoch.train_loss for epoch in epochs], label="training (with dropout)")
    loss.plot(number, [epoch.validation_loss for epoch in epochs], label="validation")
    loss.set(xlabel="epoch", ylabel="mean NLL")
    mae = np.array([epoch.mae for epoch in epochs])
    for component, name in enumerate(COMPONENTS):
        axes = translation if component < 3 else rotation
        axes.plot(number, mae[:, component], label=name)
    translation.set(xlabel="epoch", ylabel="validation MAE (mm)", yscale="log")
    rotation.set(xlabel="epoch", ylabel="validation MAE (rad)", yscale="log")
    for axes in (loss, translation, rotation):
        axes.legend()
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
