"""Speed against accuracy: image size, network size, arithmetic and threads, each measured.

    python bench/perception/dial.py --untrained                             # times alone, of random weights
    python bench/perception/dial.py DATA [--only "64 M" ...] [--run NAME=RUN ...] [--out out/dial]

DATA is a folder of the public layout with train/ and val/ in it. Each network of
config/perception/dial.yaml is trained on it (a finished run in --out is not trained again), then measured
as it is and in 8-bit integers, with further runs given by --run. Errors and calibration are on DATA/val;
times of whole estimates of simulated images, pre-processing included: in bursts, models in turn, and with a
camera's pauses at 60 Hz. Needs PyTorch and onnx (`scripts/setup.sh train`).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.extend(map(str, Path(__file__).resolve().parents[:2]))

from shared import Array, Table, needs, parser, percentiles
from stages import simulated_images

from tactile_base.config_paths import config_path
from tactile_base.yaml_file import read_yaml
from tactile_bringup.cli import main as tactile
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.model_metadata import ModelMetadata
from tactile_perception.estimating.plots import log_axis
from tactile_perception.estimating.preprocessing import PreprocessingSettings, Preprocessor
from tactile_perception.evaluation.evaluate import evaluate, load_data
from tactile_perception.evaluation.metrics import LEVELS
from tactile_perception.evaluation.models import open_models
from tactile_perception.evaluation.report import paper_tables
from tactile_perception.training.quantization import training_images

BURST, PACE_HZ = 10, 60.0
TIMES = ("CPU p50 / p99", "wall p50 / p99", "at 60 Hz", "two threads")
ERRORS = ("rho_x, rho_y, rho_z (mm)", "phi_x, phi_y, phi_z (rad)", "/ paper", "NEES / 6", "95 % covers")


@dataclass(frozen=True)
class Model:
    """A model file; `arithmetic` is fp32 or int8."""

    name: str
    arithmetic: str
    path: Path


def configs(names: list[str] | None) -> Iterator[tuple[str, Any]]:
    """Names and training configurations of `config/perception/dial.yaml`, all or those named."""
    from tactile_perception.training.config import TrainConfig

    root = read_yaml(config_path("perception/dial.yaml"))
    root.allow("config", "networks")
    base = TrainConfig.from_file(config_path(f"perception/{root.text('config')}"))
    for name, network in root.sections("networks").items():
        if names is None or name in names:
            yield name, base.merged({"network": network.values})


def untrained(out: Path, names: list[str] | None, images: np.ndarray) -> Iterator[Model]:
    """Networks with random weights, whose integers camera images calibrate."""
    import torch

    from tactile_perception.training.export import export_onnx
    from tactile_perception.training.network import PoseNetwork
    from tactile_perception.training.quantization import quantize

    for name, config in configs(names):
        torch.manual_seed(0)
        settings = PreprocessingSettings(size=config.network.image_size)
        path = out / "untrained" / f"{name.replace(' ', '_')}.onnx"
        path.parent.mkdir(parents=True, exist_ok=True)
        export_onnx(
            PoseNetwork(config.network).eval(), path, ModelMetadata(settings, {}, {"untrained": True})
        )
        prepare = Preprocessor(settings)
        prepared = np.array([prepare.resized(prepare.processed(image)) for image in images])
        yield Model(name, "fp32", path)
        yield Model(name, "int8", quantize(path, prepared, path.with_name(f"{path.stem}_int8.onnx")))


def trained(data: Path, out: Path, names: list[str] | None, runs: dict[str, Path]) -> Iterator[Model]:
    """The dial's networks, trained if need be, and further runs, both as they are and in integers."""
    import yaml

    from tactile_perception.training.quantization import QuantizationSettings, quantize

    paths = {name: run / "model.onnx" if run.is_dir() else run for name, run in runs.items()}
    for name, config in configs(names):
        folder = out / name.replace(" ", "_")
        if not (folder / "result.json").exists():
            file = out / f"{folder.name}.yaml"
            file.write_text(yaml.safe_dump(config.plain()))
            if tactile(["train", str(data), "--out", str(folder), "--config", str(file)]):
                raise SystemExit(f"{name}: not trained")
        paths[name] = folder / "model.onnx"
    for name, path in paths.items():
        quantized = out / f"{name.replace(' ', '_')}_int8.onnx"
        if not quantized.exists() or quantized.stat().st_mtime < path.stat().st_mtime:
            quantize(path, training_images(data, path, QuantizationSettings().images), quantized)
        yield Model(name, "fp32", path)
        yield Model(name, "int8", quantized)


def accuracies(models: list[Model], validation: Path) -> Iterator[tuple[float, list[str]]]:
    """Of each model, calibrated as its file says: errors over the paper's, and cells of the table."""
    opened = open_models([model.path for model in models], threads=1)
    paper = paper_tables().networks["GDN"][1]
    for result in evaluate(load_data(validation, opened), opened):
        mae, consistency = np.array(result.accuracy.mae), result.best.consistency
        assert consistency is not None
        covered = 100 * consistency.coverage[LEVELS.index(0.95)]
        ratio = float(np.exp(np.log(mae / paper).mean()))
        yield (
            ratio,
            [
                ", ".join(f"{value:.3f}" for value in mae[:3]),
                ", ".join(f"{value:.4f}" for value in mae[3:]),
                f"{ratio:.2f}",
                f"{consistency.joint:.2f}",
                f"{covered.min():.0f} to {covered.max():.0f} %",
            ],
        )


def times(models: list[Model], images: np.ndarray, count: int) -> list[dict[str, list[float]]]:
    """Median and 99 % (ms) by column of `TIMES`; models take turns in bursts, so that all see one load."""
    found: list[dict[str, list[float]]] = [{} for _ in models]
    for threads in (1, 2):
        estimators = [Estimator(model.path, threads) for model in models]
        wall, cpu, paced = np.empty((3, len(models), count))
        for start in range(0, count, BURST):
            for k, estimator in enumerate(estimators):
                estimator.estimate(images[0])
                for number in range(start, min(start + BURST, count)):
                    cpu[k, number], wall[k, number] = _estimated(estimator, images[number % len(images)])
        for number in range(count // 3 if threads == 1 else 0):
            for k, estimator in enumerate(estimators):
                image = images[number % len(images)].copy()
                time.sleep(1.0 / PACE_HZ)
                _, paced[k, number] = _estimated(estimator, image)
        for k, columns in enumerate(found):
            if threads == 2:
                columns[TIMES[3]] = percentiles(wall[k])
                continue
            for name, values in zip(TIMES, (cpu[k], wall[k], paced[k, : count // 3]), strict=False):
                columns[name] = percentiles(values)
    return found


def _estimated(estimator: Estimator, image: np.ndarray) -> tuple[float, float]:
    """Milliseconds of processor time and by the clock."""
    started, cpu = time.perf_counter(), time.process_time()
    estimator.estimate(image)
    return 1e3 * (time.process_time() - cpu), 1e3 * (time.perf_counter() - started)


def plot(models: list[Model], ms: Array, ratios: Array, path: Path, title: str) -> None:
    """Error against time; the line joins what nothing beats in both."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes, names = figure.subplots(), list(dict.fromkeys(model.name for model in models))
    for model, x, y in zip(models, ms, ratios, strict=True):
        color, int8 = f"C{names.index(model.name) % 10}", model.arithmetic == "int8"
        axes.plot(x, y, "s" if int8 else "o", color=color, markerfacecolor=color if int8 else "none")
        axes.annotate(f"{model.name} {model.arithmetic}", (x, y), xytext=(6, 4), textcoords="offset points")
    least = [i for i in np.argsort(ms) if ratios[i] <= ratios[ms <= ms[i]].min()]
    axes.plot(ms[least], ratios[least], "-", color="0.6", zorder=0)
    log_axis(axes, "x")
    axes.set(xlabel="median CPU time of an estimate (ms), pre-processing included", title=title)
    axes.set(ylabel="mean absolute error / the paper's (geometric mean)")
    figure.savefig(path, dpi=110)


def named_run(text: str) -> tuple[str, Path]:
    """NAME=RUN."""
    name, equals, path = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"{text}: must have the form NAME=RUN")
    return name, Path(path)


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("data", type=Path, nargs="?", help="data folder with train/ and val/ in it")
    arguments.add_argument("--out", type=Path, default=Path("out/dial"))
    arguments.add_argument(
        "--only", nargs="*", metavar="NAME", help="networks of config/perception/dial.yaml"
    )
    arguments.add_argument("--run", type=named_run, action="append", default=[], metavar="NAME=RUN")
    arguments.add_argument("--untrained", action="store_true", help="times only, of random weights")
    arguments.add_argument("--images", type=int, default=300, help="images timed for each model")
    given = arguments.parse_args()
    if (given.data is None) != given.untrained:
        arguments.error("needs a data folder, or --untrained for times alone")
    needs("scripts/setup.sh train", "torch", "onnx")
    given.out.mkdir(parents=True, exist_ok=True)
    images, ratios = simulated_images(24), []
    errors: list[list[str]] = []
    if given.untrained:
        models = list(untrained(given.out, given.only, images))
    else:
        models = list(trained(given.data, given.out, given.only, dict(given.run)))
        ratios, errors = map(list, zip(*accuracies(models, given.data / "val"), strict=True))
    measured = times(models, images, given.images)
    heads = ("network", "arithmetic", "MB", *TIMES, *(ERRORS if errors else ()))
    table = Table(heads, f"p50 / p99 of {given.images} estimates, ms", timed=True)
    for k, model in enumerate(models):
        shown = (" / ".join(f"{value:.2f}" for value in measured[k][name]) for name in TIMES)
        size = f"{model.path.stat().st_size / 1e6:.2f}"
        table.row(model.name, model.arithmetic, size, *shown, *(errors[k] if errors else ()))
    if errors:
        cpu = np.array([columns[TIMES[0]][0] for columns in measured])
        plot(models, cpu, np.array(ratios), given.out / "pareto.png", f"errors on {given.data.name}/val")


if __name__ == "__main__":
    main()
