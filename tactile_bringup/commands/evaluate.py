"""Measure trained networks on labelled data: the paper's tables and figures, how honest their uncertainty is.

`tactile evaluate filter` runs the paper's filter experiment.
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from tactile_base.console import say, wide_console
from tactile_base.progress import Progress
from tactile_base.settings import SettingError
from tactile_base.whole_file import room_for_results
from tactile_bringup.commands.changes import (
    add_command,
    add_set_option,
    changed_settings,
    natural_int,
    positive_int,
)
from tactile_perception.evaluation import filter_experiment, report
from tactile_perception.evaluation.evaluate import evaluate, load_data
from tactile_perception.evaluation.filter_experiment import SIGMAS, Experiment
from tactile_perception.evaluation.models import open_models
from tactile_perception.evaluation.plots import draw_all
from tactile_perception.evaluation.report import paper_tables, summary, write_files

MODES = ("network", "filter")


def register(subparsers: Any) -> None:
    parser = add_command(subparsers, "evaluate", run_evaluate, __doc__, status=1)
    add = parser.add_argument
    add("mode", nargs="?", choices=MODES, default="network", help="what to measure (network)")
    add("--data", type=Path, required=True, help="labelled folder of the public layout")
    text = "run folders of `tactile train`, folders of such folders, or ONNX files"
    add("--model", type=Path, nargs="+", required=True, metavar="RUN", help=text)
    add("--out", type=Path, help="folder for tables and figures (out/evaluate)")
    add("--json", action="store_true", help="print the results as JSON instead of tables")
    add("--ensemble", action="store_true", help="also all of these models together, moment-matched")
    text = "calibrate on this labelled folder, which no model was trained on, not as the model files say"
    add("--calibrate", type=Path, metavar="DIR", help=text)
    add("--limit", type=positive_int, metavar="N", help="use only N samples, spread over the table")
    add("--threads", type=natural_int, default=0, help="CPU threads of an inference (0: all cores)")
    add("--no-figures", action="store_true", help="tables only")
    add("--paper", action="store_true", help="the paper's results, too (filter: in brackets, + if reached)")
    _register_filter(parser.add_argument_group("filter"))


def _register_filter(group: Any) -> None:
    add = group.add_argument
    text = "noises sigma_psi of the motion in mm and degrees (inf 10 1 0.1 0.01)"
    add("--sigma", type=float, nargs="+", metavar="S", help=text)
    add("--seed", type=natural_int, default=0, help="order of the samples and noise of the motion (0)")
    add("--repeat", type=positive_int, default=1, metavar="N", help="mean over N orders, from --seed on")
    text = "also with sigma_phi estimated from the innovations of the first 500 samples"
    add("--estimate-noise", action="store_true", help=text)
    add_set_option(group, "change a setting of the filter (the paper's, without a gate)")


def run_evaluate(arguments: argparse.Namespace) -> int:
    console = Console(stderr=True)
    run = _run_filter if arguments.mode == "filter" else _run_network
    say(console, f"files: {run(arguments, console)}")
    return 0


def _run_network(arguments: argparse.Namespace, console: Console) -> Path:

    data, results, out = _predict(arguments, console)
    write_files(out, data, results)
    if not arguments.no_figures:
        draw_all(out, data, results)
    if arguments.json:
        print(json.dumps(summary(data, results), allow_nan=False))
    else:
        _print_tables(wide_console(), results, arguments.paper)
    return out


def _run_filter(arguments: argparse.Namespace, console: Console) -> Path:

    experiment = _experiment(arguments)
    data, results, out = _predict(arguments, console)
    tasks = len(list(filter_experiment.states(results)))
    if not tasks:
        raise ValueError("none of the models says how uncertain it is: there is nothing to filter")
    with Progress(console) as progress:
        total = tasks * experiment.runs
        advance = partial(progress.advance, "filtering", total=total, unit="sequences")
        found = filter_experiment.run_experiment(data, results, experiment, advance)
    filter_experiment.write_filter_files(out, found)
    if not arguments.no_figures:
        filter_experiment.draw_filter_figure(out, data, results, experiment)
    if arguments.json:
        print(json.dumps(filter_experiment.filter_summary(data, found), allow_nan=False))
    else:
        goal = paper_tables().filter if arguments.paper else None
        for table in filter_experiment.filter_tables(found, goal):
            wide_console().print(table)
    return out


def _experiment(arguments: argparse.Namespace) -> Any:

    for sigma in arguments.sigma or ():
        if not sigma > 0.0:
            raise SettingError(f"--sigma {sigma:g}: must be positive, or inf")
    return Experiment(
        sigmas=tuple(arguments.sigma or SIGMAS),
        seeds=tuple(range(arguments.seed, arguments.seed + arguments.repeat)),
        estimated=arguments.estimate_noise,
        settings=Experiment().settings.replaced(**changed_settings(arguments.changes, "fusion_mode=exact")),
    )


def _predict(arguments: argparse.Namespace, console: Console) -> tuple[Any, Any, Path]:
    """Data, results of each model, and the folder for files; says what there is to know about the data."""
    out = arguments.out or Path("out/evaluate")
    room_for_results(out, "results.json", "filter.csv", source=arguments.data)  # before the images are read
    models = open_models(arguments.model, arguments.threads)
    with Progress(console) as progress:
        reading = partial(progress.update, "reading", unit="images")
        data = load_data(arguments.data, models, arguments.limit, reading)
        held_out = load_data(arguments.calibrate, models) if arguments.calibrate else None
        total = len(models) * (len(data) + (len(held_out) if held_out else 0))
        advance = partial(progress.advance, "predicting", total=total, unit="images")
        results = evaluate(data, models, arguments.ensemble, held_out, advance)
    for line in data.report.lines() + [f"note: {note}" for note in data.notes]:
        say(console, line)
    out.mkdir(parents=True, exist_ok=True)
    return data, results, out


def _print_tables(console: Console, results: Any, paper: bool) -> None:

    console.print(report.accuracy_table(results, report.paper_tables() if paper else None))
    for name, members in report.groups(results).items():
        table = report.calibration_table(members, name)
        if table is not None:
            console.print(table)
        console.print(report.bins_table(members, name, "by_depth"))
        console.print(report.bins_table(members, name, "by_shear"))
