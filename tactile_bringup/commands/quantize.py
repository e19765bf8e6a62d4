"""Write a trained network in 8-bit integers, which takes less than half the time.

Both are compared on the validation data. It needs onnx, of the extra 'train'.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from tactile_base.console import number_table
from tactile_base.whole_file import check_file, copy_whole, room_for_files
from tactile_bringup.commands.changes import add_command, add_set_option, changed_settings
from tactile_perception.datasets.dataset import open_folder
from tactile_perception.datasets.layout import parts_of
from tactile_perception.estimating.model_metadata import QUANTIZED_NAME, trained_model
from tactile_perception.evaluation.evaluate import evaluate, load_data
from tactile_perception.evaluation.models import open_models

_TIMED_RUNS = 200


def register(subparsers: Any) -> None:
    parser = add_command(subparsers, "quantize", run_quantize, __doc__, status=1)
    add = parser.add_argument
    add("model", type=Path, help="run folder of `tactile train`, or an ONNX file")
    text = "training data, which give the ranges of the activations: a folder, or one with train/ in it"
    add("--data", type=Path, required=True, help=text)
    add("--val", type=Path, help="data to compare both networks on (default: DATA/val)")
    add("--out", type=Path, metavar="FILE", help=f"default: {QUANTIZED_NAME} beside the model")
    add("--install", type=Path, metavar="FILE", help="copy the quantized model to FILE")
    add_set_option(parser, "change one setting")


def run_quantize(arguments: argparse.Namespace) -> int:
    from tactile_perception.training.quantization import QuantizationSettings, quantize, training_images

    settings = QuantizationSettings().replaced(**changed_settings(arguments.changes, "images=300"))
    source, out = _paths(arguments.model, arguments.out)
    validation = _validation(arguments.data, arguments.val)
    for path in (out, *filter(None, [arguments.install])):
        check_file(path)
    images = training_images(arguments.data, source, settings.images)
    out.parent.mkdir(parents=True, exist_ok=True)
    room_for_files(out)
    quantize(source, images, out, settings)
    print(f"model: {out}")
    _compare([source, out], validation)
    if arguments.install:
        copy_whole(out, arguments.install)
    return 0


def quantize_run(run: Path, data: Path, validation: Path | None = None) -> Path:
    """Quantize the model of a run folder as it is meant to be, print the comparison; returns the new file."""
    from tactile_perception.training.quantization import QuantizationSettings, quantize, training_images

    source, out = _paths(run, None)
    quantize(source, training_images(data, source, QuantizationSettings().images), out)
    print(f"quantized model: {out}")
    _compare([source, out], _validation(data, validation))
    return out


def _validation(data: Path, given: Path | None) -> Path | None:
    """The folder to compare on, if there is one; `DatasetError` if it is none."""
    folder = given or parts_of(data).get("val")
    if folder is not None:
        open_folder(folder)
    return folder


def _paths(model: Path, out: Path | None) -> tuple[Path, Path]:
    source = trained_model(model)
    out = out or source.with_name(QUANTIZED_NAME)
    if out.resolve() == source.resolve():
        raise ValueError(f"{out}: is the model itself; --out must name another file")
    return source, out


def _compare(paths: Sequence[Path], validation: Path | None) -> None:

    models = open_models(paths, threads=1)
    names = ["size", "network, p50 / p99"]
    columns = [
        [f"{model.estimator.path.stat().st_size / 1e6:.2f} MB", _milliseconds(model)] for model in models
    ]
    title = "on one core"
    if validation is not None:
        title += f"; mean absolute error on {validation}"
        results = evaluate(load_data(validation, models), models)
        for column, result in zip(columns, results, strict=True):
            mae = zip(result.accuracy.mae, result.units, strict=True)
            column += [f"{value:.4f} {unit}" for value, unit in mae]
        names += results[0].names
    table = number_table(title, ["", *(path.name for path in paths)])
    for row in zip(names, *columns, strict=True):
        table.add_row(*row)
    Console().print(table)


def _milliseconds(model: Any) -> str:
    side = model.metadata.preprocessing.size
    image = np.zeros((1, 1, side, side), np.float32)
    seconds = []
    for _ in range(_TIMED_RUNS):
        model.estimator.estimate_prepared(image)
        seconds.append(model.estimator.times.infer)
    return " / ".join(f"{1e3 * np.percentile(seconds, q):.2f}" for q in (50, 99)) + " ms"
