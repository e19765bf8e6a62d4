"""The networks that the dial compares: trained if need be, as they are and in 8-bit integers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import yaml
from numpy.typing import NDArray

from tactile_base.config_paths import config_path
from tactile_base.yaml_file import read_yaml
from tactile_bringup.cli import main as tactile
from tactile_perception.estimating.model_metadata import ModelMetadata
from tactile_perception.estimating.preprocessing import PreprocessingSettings, Preprocessor
from tactile_perception.training.config import TrainConfig
from tactile_perception.training.export import export_onnx
from tactile_perception.training.network import PoseNetwork
from tactile_perception.training.quantization import QuantizationSettings, quantize, training_images

CONFIG = "perception/dial.yaml"
SIMULATED = {"--train": "2000", "--val": "500", "--seed": "1"}


@dataclass(frozen=True)
class Candidate:
    """A model file. `schedule` says how it was trained, `arithmetic` is fp32 or int8."""

    name: str
    arithmetic: str
    path: Path
    schedule: str


def data_folder(given: Path | None, out: Path) -> Path:
    """The data folder, or one of simulated samples in its place."""
    if given is not None:
        return given
    folder = out / "simulated"
    print(
        f"NO DATA FOLDER WAS GIVEN: falling back to {SIMULATED['--train']} simulated samples in {folder}.\n"
        "The times are what they are; the errors tell nothing of a real sensor."
    )
    options = [text for pair in SIMULATED.items() for text in pair]
    if tactile(["data", "generate", str(folder), *options]):
        raise SystemExit("no simulated data")
    return folder


def candidates(
    data: Path, out: Path, names: list[str] | None, runs: dict[str, Path], epochs: int | None
) -> list[Candidate]:
    """Networks of `config/perception/dial.yaml` (all, or those named) and further runs, in fp32 and int8."""
    found: list[Candidate] = []
    for name, config in dial_configs(epochs).items():
        if names is not None and name not in names:
            continue
        folder = out / "runs" / name.replace(" ", "_")
        if not (folder / "result.json").exists():
            print(f"{name}: training {config.training.epochs} epochs in {folder}", flush=True)
            file = _write(config, out / "configs" / f"{folder.name}.yaml")
            if tactile(["train", str(data), "--out", str(folder), "--config", str(file)]):
                raise SystemExit(f"{name}: not trained")
        found += _both(name, folder / "model.onnx", data, out, f"{config.training.epochs} epochs")
    for name, run in runs.items():
        path = run / "model.onnx" if run.is_dir() else run
        found += _both(name, path, data, out, "its own")
    return found


def untrained(out: Path, names: list[str] | None, images: NDArray[np.uint8]) -> list[Candidate]:
    """The same networks with random weights, for their times alone; camera images calibrate the integers."""
    found = []
    for name, config in dial_configs().items():
        if names is not None and name not in names:
            continue
        torch.manual_seed(0)
        settings = PreprocessingSettings(size=config.network.image_size)
        metadata = ModelMetadata(settings, {}, {"untrained": True})
        path = out / "untrained" / f"{name.replace(' ', '_')}.onnx"
        path.parent.mkdir(parents=True, exist_ok=True)
        export_onnx(PoseNetwork(config.network).eval(), path, metadata)
        preprocessor = Preprocessor(settings)
        prepared = np.array([preprocessor.resized(preprocessor.binary(image)) for image in images])
        quantized = quantize(path, prepared, path.with_name(f"{path.stem}_int8.onnx"))
        found += [Candidate(name, "fp32", path, "none"), Candidate(name, "int8", quantized, "none")]
    return found


def dial_configs(epochs: int | None = None) -> dict[str, TrainConfig]:
    """Training configurations by name; `epochs` in place of the training file's."""
    root = read_yaml(config_path(CONFIG))
    root.allow("config", "networks")
    base = TrainConfig.from_file(config_path(f"perception/{root.text('config')}"))
    if epochs is not None:
        training = base.training
        before = training.rise_epochs + training.hold_epochs
        base = base.replaced(training__decay_epochs=epochs - before)
    networks = root.sections("networks")
    return {name: base.merged({"network": network.values}) for name, network in networks.items()}


def _write(config: TrainConfig, file: Path) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(yaml.safe_dump(config.plain()))
    return file


def _both(name: str, path: Path, data: Path, out: Path, schedule: str) -> list[Candidate]:
    quantized = out / "int8" / f"{name.replace(' ', '_')}.onnx"
    quantized.parent.mkdir(parents=True, exist_ok=True)
    if not quantized.exists() or quantized.stat().st_mtime < path.stat().st_mtime:
        quantize(path, training_images(data, path, QuantizationSettings().images), quantized)
    return [Candidate(name, "fp32", path, schedule), Candidate(name, "int8", quantized, schedule)]
