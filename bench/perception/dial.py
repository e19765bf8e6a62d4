r"""Speed against accuracy: image size, network size, arithmetic and threads, each measured.

    PYTHONSAFEPATH= python bench/perception/dial.py [DATA] [--out out/dial] [--only "64 M" ...] \
        [--run NAME=RUN ...]

DATA is a folder of the public layout with train/ and val/ in it; without it, simulated samples are generated.
Each network of config/perception/dial.yaml is trained on it by the same file (a finished run is not
trained again; --epochs shortens it), quantized to 8-bit integers, and measured: errors and calibration on
val/, and the time of a whole estimate, pre-processing included, one after another and at 60 Hz. `--run` adds
networks that were trained otherwise; `--only` without names trains none; `--untrained` measures times alone
and needs no data. Leaves dial.csv, dial.md and pareto.png in --out.

All models are timed in turn, over and over, so that what else the machine does meets them all alike.
"""

from __future__ import annotations

import argparse
import csv
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import onnxruntime
from candidates import Candidate, candidates, data_folder, untrained
from numpy.typing import NDArray
from report import draw_pareto, markdown_table
from stages import simulated_images

from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.labels import COMPONENTS
from tactile_perception.evaluation.evaluate import evaluate, load_data
from tactile_perception.evaluation.metrics import LEVELS
from tactile_perception.evaluation.models import open_models

_BURST = 10
_PACE_HZ = 60.0


@dataclass
class Row:
    """What was measured of one model; times in ms over a whole estimate, errors in mm and rad."""

    name: str
    arithmetic: str
    path: Path
    schedule: str
    mae: tuple[float, ...] = (np.nan,) * 6
    nees: float = np.nan
    coverage95: tuple[float, float] = (np.nan, np.nan)
    network_p50: float = np.nan
    p50: float = np.nan
    p99: float = np.nan
    cpu_p50: float = np.nan
    cpu_p99: float = np.nan
    p50_two_threads: float = np.nan
    p99_two_threads: float = np.nan
    paced_p50: float = np.nan
    paced_p99: float = np.nan

    @property
    def megabytes(self) -> float:
        """Size of the model file."""
        return self.path.stat().st_size / 1e6


def main() -> None:
    arguments = _arguments()
    arguments.out.mkdir(parents=True, exist_ok=True)
    images = simulated_images(24)
    if arguments.untrained:
        models = untrained(arguments.out, arguments.only, images)
        rows = [Row(*vars(model).values()) for model in models]
    else:
        data = data_folder(arguments.data, arguments.out)
        models = candidates(data, arguments.out, arguments.only, dict(arguments.run), arguments.epochs)
        rows = accuracies(models, data / "val")
    measure_times(models, rows, images, arguments.images)
    _write_csv(rows, arguments.out / "dial.csv")
    table = markdown_table(rows)
    (arguments.out / "dial.md").write_text(table + "\n")
    print(table)
    print(f"bf16: {bf16_support()}")
    if not arguments.untrained:
        draw_pareto(rows, arguments.out / "pareto.png", f"errors on {data.name}/val")
    print(f"results in {arguments.out}")


def accuracies(models: list[Candidate], validation: Path) -> list[Row]:
    """Errors and calibration of each model, as its file says to calibrate it."""
    opened = open_models([model.path for model in models], threads=1)
    results = evaluate(load_data(validation, opened), opened)
    rows = []
    for model, result in zip(models, results, strict=True):
        consistency = result.best.consistency
        assert consistency is not None
        covered = consistency.coverage[LEVELS.index(0.95)]
        rows.append(
            Row(
                *vars(model).values(),
                mae=tuple(result.accuracy.mae.tolist()),
                nees=consistency.joint,
                coverage95=(float(covered.min()), float(covered.max())),
            )
        )
    return rows


def measure_times(models: list[Candidate], rows: list[Row], images: NDArray[np.uint8], count: int) -> None:
    """Fill in the times of `rows`, over `count` images for each model."""
    for threads in (1, 2):
        estimators = [Estimator(model.path, threads) for model in models]
        measured = _interleaved(estimators, images, count)
        for row, seconds, network, cpu in zip(rows, *measured, strict=True):
            p50, p99 = (float(1e3 * np.percentile(seconds, q)) for q in (50, 99))
            if threads == 1:
                row.p50, row.p99, row.network_p50 = p50, p99, float(1e3 * np.median(network))
                row.cpu_p50, row.cpu_p99 = (float(1e3 * np.percentile(cpu, q)) for q in (50, 99))
            else:
                row.p50_two_threads, row.p99_two_threads = p50, p99
        if threads == 1:
            for row, seconds in zip(rows, _paced(estimators, images, count // 3), strict=True):
                row.paced_p50, row.paced_p99 = (float(1e3 * np.percentile(seconds, q)) for q in (50, 99))


def _interleaved(estimators: list[Estimator], images: NDArray[np.uint8], count: int) -> NDArray[np.float64]:
    """Seconds (3, models, count) of estimates, of the network in them, and of CPU; in bursts, in turn."""
    total, network, cpu = result = np.empty((3, len(estimators), count))
    for start in range(0, count, _BURST):
        for index, estimator in enumerate(estimators):
            estimator.estimate(images[0])
            for number in range(start, min(start + _BURST, count)):
                started, cpu_started = time.perf_counter(), time.process_time()
                estimator.estimate(images[number % len(images)])
                total[index, number] = time.perf_counter() - started
                cpu[index, number] = time.process_time() - cpu_started
                network[index, number] = estimator.times.infer
    return result


def _paced(estimators: list[Estimator], images: NDArray[np.uint8], count: int) -> NDArray[np.float64]:
    """Seconds (models, count) of estimates with a camera's pauses between them."""
    result = np.empty((len(estimators), count))
    for number in range(count):
        for index, estimator in enumerate(estimators):
            image = images[number % len(images)].copy()
            time.sleep(1.0 / _PACE_HZ)
            started = time.perf_counter()
            estimator.estimate(image)
            result[index, number] = time.perf_counter() - started
    return result


def bf16_support() -> str:
    """What onnxruntime says to a convolution in bfloat16 on this CPU."""
    from onnx import TensorProto, helper

    kind = TensorProto.BFLOAT16
    weight = helper.make_tensor("weight", kind, [1, 1, 3, 3], [0.0] * 9)
    graph = helper.make_graph(
        [helper.make_node("Conv", ["x", "weight"], ["y"], kernel_shape=[3, 3])],
        "bf16",
        [helper.make_tensor_value_info("x", kind, [1, 1, 8, 8])],
        [helper.make_tensor_value_info("y", kind, [1, 1, 6, 6])],
        [weight],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 22)], ir_version=10)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    try:
        onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions share no base class of their own
        return f"onnxruntime {onnxruntime.__version__} on this CPU: {str(error).splitlines()[0]}"
    return f"onnxruntime {onnxruntime.__version__} on this CPU runs convolutions in bfloat16"


def _write_csv(rows: list[Row], path: Path) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        plain = [name for name in asdict(rows[0]) if name not in ("mae", "coverage95", "path")]
        plain.append("megabytes")
        writer.writerow([*plain, *(f"mae_{name}" for name in COMPONENTS), "coverage95_min", "coverage95_max"])
        for row in rows:
            writer.writerow([*(getattr(row, name) for name in plain), *row.mae, *row.coverage95])


def _named_run(text: str) -> tuple[str, Path]:
    name, equals, path = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"{text}: must have the form NAME=RUN")
    return name, Path(path)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="data folder with train/ and val/ in it")
    parser.add_argument("--out", type=Path, default=Path("out/dial"))
    parser.add_argument("--only", nargs="*", metavar="NAME", help="networks of config/perception/dial.yaml")
    parser.add_argument("--epochs", type=int, help="in place of the training file's")
    parser.add_argument("--run", type=_named_run, action="append", default=[], metavar="NAME=RUN")
    parser.add_argument(
        "--untrained", action="store_true", help="times only, of networks with random weights"
    )
    parser.add_argument("--images", type=int, default=300, help="images timed for each model")
    return parser.parse_args()


if __name__ == "__main__":
    main()
