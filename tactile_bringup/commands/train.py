"""The commands `tactile train` and `tactile ensemble`."""

from __future__ import annotations

import argparse
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from tactile_base.console import number_table, say
from tactile_base.jobs import run_jobs
from tactile_base.whole_file import check_file, copy_whole, write_csv
from tactile_bringup.commands.changes import (
    add_command,
    add_job_options,
    add_set_option,
    in_words,
    positive_int,
    workers_of,
)
from tactile_bringup.commands.quantize import quantize_run
from tactile_perception.estimating.labels import COMPONENTS, NETWORK_UNITS, errors_in_words
from tactile_perception.estimating.model_metadata import MODEL_NAME, QUANTIZED_NAME
from tactile_perception.training.config import TrainConfig, profile


def register(subparsers: Any) -> None:
    parser = add_command(subparsers, "train", run_train, status=1, wrong=(FloatingPointError,))
    add = parser.add_argument
    add("data", type=Path, help="data folder, or a folder with train/ and val/ in it")
    add("--val", type=Path, help="validation data folder (default: DATA/val, or what is held back)")
    add("--out", type=Path, required=True, help="new folder for the run")
    choice = parser.add_mutually_exclusive_group()
    text = "YAML file with the sections network, training and augmentation"
    choice.add_argument("--config", type=Path, help=text)
    text = "a choice between speed and accuracy, of config/perception/profiles.yaml; a network of 8-bit "
    text += f"integers is written beside the trained one, as {QUANTIZED_NAME}"
    choice.add_argument("--profile", metavar="NAME", help=text)
    add_set_option(parser, "change one setting", "SECTION.NAME=VALUE")
    text = "start from the network of a finished run, as one trained on simulated images"
    add("--start", type=Path, metavar="RUN", help=text)
    text = "contact model, what the network tells: surface (default), edge, surface_force, or another "
    add("--model", metavar="NAME", help=text + "package's (`tactile plugins --all`)")
    add("--limit", type=positive_int, metavar="N", help="use only N training samples")
    add("--install", type=Path, metavar="FILE", help="copy the exported model to FILE")
    several = parser.add_mutually_exclusive_group()
    text = "N networks of other seeds, in OUT/seed_0 and on"
    several.add_argument("--repeat", type=positive_int, metavar="N", help=text)
    text = "N networks that each hold back another part of the data, in OUT/fold_0 and on, joined in one "
    text += "model that all the data calibrate: for some hundred contacts"
    several.add_argument("--folds", type=positive_int, metavar="N", help=text)
    add_job_options(parser, default=1, those="with --repeat or --folds: ")
    _register_ensemble(subparsers)


def _register_ensemble(subparsers: Any) -> None:
    add = add_command(subparsers, "ensemble", run_ensemble, status=1).add_argument
    add("runs", nargs="+", type=Path, help="run folders of `tactile train`, or ONNX files")
    add("--out", type=Path, required=True, metavar="FILE", help="the ONNX file to write")
    add("--data", type=Path, help="training data (as of the runs): calibrate on what the runs held back")


def run_train(arguments: argparse.Namespace) -> int:
    """Train a pose network (needs PyTorch, the extra 'train').

    A run that was interrupted goes on when the same command is given again.
    """
    if arguments.folds is not None:
        return _train_folds(arguments)
    return _train_one(arguments) if arguments.repeat is None else _train_many(arguments)


def _config(arguments: argparse.Namespace) -> Any:

    if arguments.profile:
        chosen = profile(arguments.profile)
        config = TrainConfig.from_file(chosen.config).merged({"network": chosen.network})
    else:
        config = TrainConfig.from_file(arguments.config) if arguments.config else TrainConfig()
    if arguments.start:
        config = config.replaced(training__start=str(arguments.start.absolute()))
    if arguments.model:
        config = config.replaced(training__model=arguments.model)
    return config.changed(arguments.changes)


def _train_one(arguments: argparse.Namespace) -> int:
    from tactile_perception.training.processes import Processes
    from tactile_perception.training.progress import TrainingDisplay
    from tactile_perception.training.train import train

    if arguments.scheduler or arguments.jobs != 1:
        raise ValueError("--jobs and --scheduler spread many runs: they need --repeat or --folds")
    config = _config(arguments)
    if arguments.install:
        check_file(arguments.install)
    if not _only_quantization_left(arguments, config):
        with TrainingDisplay() as progress:
            train(arguments.data, arguments.out, config, arguments.val, arguments.limit, progress)
    if not Processes().first:
        return 0
    _print_result(arguments.out)
    model = arguments.out / MODEL_NAME
    if _quantized(arguments):
        model = quantize_run(arguments.out, arguments.data, arguments.val)
    if arguments.install:
        copy_whole(model, arguments.install)
    return 0


def _quantized(arguments: argparse.Namespace) -> bool:
    """Whether the profile's networks are used in 8-bit integers."""
    return bool(arguments.profile) and profile(arguments.profile).quantized


def _only_quantization_left(arguments: argparse.Namespace, config: Any) -> bool:
    """Whether the run was interrupted when it was trained, but not yet quantized."""
    from tactile_perception.training.run_folder import RunFolder

    folder = RunFolder(arguments.out)
    if not (_quantized(arguments) and folder.finished) or folder.file(QUANTIZED_NAME).exists():
        return False
    folder.check_same(config)
    return True


def _print_result(out: Path) -> None:
    from tactile_perception.training.run_folder import RunFolder

    console, result = Console(), RunFolder(out).result()
    if "folds" in result:
        title, stopped = f"{result['folds']} networks, each on what it held back", ""
    else:
        loss = f"{result['loss']} {result['validation_loss']:.3f}"
        title = f"epoch {result['best_epoch']} of {result['epochs']}: {loss}"
        stopped = f"; stopped: {result['stopped']}"
    table = number_table(title, ["component", "MAE"])
    for name, unit in _units(result).items():
        table.add_row(name, f"{result['mae'][name]:.4f} {unit}" if name in result["mae"] else "not labelled")
    console.print(table)
    say(console, f"{result['minutes']:.1f} min{stopped}")
    say(console, f"run: {out} (model: {out / MODEL_NAME})")


def _units(result: dict[str, Any]) -> dict[str, str]:
    """The units of a finished run's errors, by name; a run from before they were told has a surface's."""
    units: dict[str, str] = result.get("units", dict(zip(COMPONENTS, NETWORK_UNITS, strict=True)))
    return units


def _train_many(arguments: argparse.Namespace) -> int:
    from tactile_perception.training import jobs  # needs PyTorch, which options and help do not

    console = Console(stderr=True)
    if arguments.install:
        raise ValueError("--install takes the model of one run: leave out --repeat")
    runs = jobs.seed_jobs(
        arguments.data, arguments.out, _config(arguments), arguments.repeat, arguments.val, arguments.limit
    )
    errors = _train_all(runs, arguments, console)
    _print_repeat(arguments.out, runs)
    if _quantized(arguments):
        for job in runs:
            if job.folder.finished and not job.folder.file(QUANTIZED_NAME).exists():
                quantize_run(job.folder.path, arguments.data, arguments.val)
    return 1 if errors else 0


def _train_folds(arguments: argparse.Namespace) -> int:
    from tactile_perception.training import jobs
    from tactile_perception.training.ensemble import write_folds
    from tactile_perception.training.run_folder import RunFolder

    if arguments.folds < 2 or arguments.limit or _quantized(arguments):
        raise ValueError("--folds takes two and more, and neither --limit nor a profile of 8-bit integers")
    folder = RunFolder(arguments.out)
    folder.check_free()
    if arguments.install:
        check_file(arguments.install)
    runs = jobs.fold_jobs(arguments.data, arguments.out, _config(arguments), arguments.folds, arguments.val)
    if _train_all(runs, arguments, Console(stderr=True)):
        return 1
    paths = [job.folder.path for job in runs]
    folder.finish_folds(paths, write_folds(paths, folder.file(MODEL_NAME), arguments.data))
    _print_result(arguments.out)
    if arguments.install:
        copy_whole(folder.file(MODEL_NAME), arguments.install)
    return 0


def _train_all(runs: Sequence[Any], arguments: argparse.Namespace, console: Console) -> list[str]:
    """Train those that are not there yet; why some came to nothing."""
    from tactile_perception.training import jobs

    waiting = jobs.unfinished(runs)
    if len(waiting) < len(runs):
        say(console, f"{len(runs) - len(waiting)} of {len(runs)} runs are already there")
    errors: list[str] = []

    def report(job: jobs.Job, error: str) -> None:
        if error:
            errors.append(error)
            say(console, f"{job.name}: {error}", "red")
        else:
            say(console, _line(job.name, job.folder.result()))

    if arguments.jobs == 1 and not arguments.scheduler:
        for job in waiting:
            report(job, _train_here(job, console))
    else:
        tell = functools.partial(say, console)
        for done in run_jobs(jobs.train_job, waiting, workers_of(arguments), tell, apart=True):
            if done.value is not None:
                jobs.store_files(done.job, done.value)
            report(done.job, "" if done.error is None else in_words(done.error))
    return errors


def _train_here(job: Any, console: Console) -> str:
    """One of many runs, in this process and with its progress; returns why it came to nothing, or ""."""
    from tactile_perception.training.progress import TrainingDisplay
    from tactile_perception.training.train import train

    say(console, job.name)
    try:
        with TrainingDisplay() as progress:
            train(job.data, job.out, job.config, job.validation, job.limit, progress)
    except FloatingPointError as error:  # of this seed; another may do
        return str(error)
    return ""


def _line(name: str, result: dict[str, Any]) -> str:
    mae = errors_in_words(result["mae"], _units(result))
    return f"{name}: {result['loss']} {result['validation_loss']:.3f}  MAE {mae}  {result['minutes']:.1f} min"


def _print_repeat(out: Path, runs: Sequence[Any]) -> None:
    """Means and deviations over the finished runs, as in the paper's table, and `repeat.csv` with each."""
    results = {job.name: job.folder.result() for job in runs if job.folder.finished}
    if not results:
        return
    first = next(iter(results.values()))
    loss, known = first["loss"], {name: unit for name, unit in _units(first).items() if name in first["mae"]}
    rows = {
        name: [result["validation_loss"], *(result["mae"][component] for component in known)]
        for name, result in results.items()
    }
    units = [f"MAE {name} ({unit})" for name, unit in known.items()]
    write_csv(out / "repeat.csv", ["run", loss, *units], ([name, *row] for name, row in rows.items()))
    values = np.array(list(rows.values()))
    deviation = values.std(axis=0, ddof=1) if len(values) > 1 else np.full(values.shape[1], np.nan)
    title = f"{len(values)} of {len(runs)} networks, on validation data"
    table = number_table(title, ["", "mean", "deviation", "best"])
    for name, column, spread in zip([loss, *units], values.T, deviation, strict=True):
        table.add_row(name, f"{column.mean():.4f}", f"{spread:.4f}", f"{column.min():.4f}")
    console = Console()
    console.print(table)
    say(console, f"table: {out / 'repeat.csv'}")


def run_ensemble(arguments: argparse.Namespace) -> int:
    """Write one ONNX model that gives the mean and covariance of the mixture of several networks.

    It costs as much time as all of them.
    """
    from tactile_perception.training.ensemble import write_ensemble

    check_file(arguments.out)
    path = write_ensemble(arguments.runs, arguments.out, arguments.data)
    print(f"model: {path} ({len(arguments.runs)} networks, {path.stat().st_size / 1e6:.1f} MB)")
    return 0
