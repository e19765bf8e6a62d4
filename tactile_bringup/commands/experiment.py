"""The paper's tables of pushing, maps of where it works, and friction models on real pushes."""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console

from tactile_base.array_math import array_math
from tactile_base.console import number_table, say, wide_console
from tactile_base.jobs import JobRows, Row, Workers, run_jobs
from tactile_base.progress import Progress
from tactile_base.whole_file import check_folder, only_writer, whole_file
from tactile_bringup.commands.changes import (
    add_command,
    add_group,
    add_job_options,
    add_set_option,
    natural_int,
    positive_int,
    workers_of,
)
from tactile_bringup.commands.simulate import deliver
from tactile_bringup.experiments import real_pushes_results as results
from tactile_bringup.experiments.pushing import (
    IDEAL,
    PLANE,
    Common,
    Trial,
    check_trial,
    map_of,
    table_of,
    trial_row,
    trial_run,
)
from tactile_bringup.experiments.pushing_offsets import CELLS, Rows, fit_lines, fit_offsets
from tactile_bringup.experiments.pushing_plane import SIDE_BY_SIDE, batches, plane_rows
from tactile_bringup.experiments.pushing_results import (
    COLUMNS,
    cell,
    failures,
    markdown,
    table_rows,
    write_map,
    write_table,
)
from tactile_records.collecting.parameters import check_same_run


def register(subparsers: Any) -> None:
    kinds = add_group(subparsers, "experiment", __doc__)
    _register_pushing(kinds)
    _register_offsets(kinds)
    _register_real_pushes(kinds)


def _register_pushing(kinds: Any) -> None:
    help = "the paper's tables, maps of where pushing works"
    epilog = "exit codes: 0 all trials came to the target; 1 some did not; 2 wrong input; 130 interrupted"
    parser = add_command(kinds, "pushing", run, help=help, epilog=epilog)
    add = parser.add_argument
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--table", metavar="NAME", help="one of the paper's tables: single, dual or tall")
    which.add_argument("--map", metavar="NAME", help="one of config/experiments/pushing_maps.yaml")
    add("--trials", type=positive_int, default=5, metavar="N", help="of each row, or each place of a map (5)")
    text = "run this trial of each row, or place, or that of this name, with report, pictures and record"
    add("--trial", metavar="NUMBER|NAME", help=text)
    add("--seed", type=natural_int, default=0, metavar="N", help="number of the first trial (0)")
    add("--objects", nargs="+", default=(), metavar="NAME", help="(default: all of the table)")
    add("--floors", nargs="+", default=(), metavar="NAME", help="(default: all of the table)")
    add("--controller", default="paper", metavar="NAME", help="paper, tuned or offset (default: paper)")
    add("--fidelity", metavar="NAME",
        help="of the sensors; plane: ideal ones, all trials side by side (default: the map's, else ideal)",
    )  # fmt: skip
    add("--device", default="numpy", metavar="NAME",
        help="of fidelity plane: numpy, or torch or jax where installed, as torch:cuda (default: numpy)",
    )  # fmt: skip
    add("--filter", default="", metavar="NAME", help="one of config/filters, or a file")
    add("--latency", type=float, default=10.0, metavar="MS", help="exposure to command in ms (default: 10)")
    add_set_option(parser, "a setting on top of the files, again and again", "ROLE.GROUP.NAME=VALUE")
    add("--arm", default="", metavar="NAME", help="run this arm only (default: all with a role)")
    add_job_options(parser)
    add("--out", type=Path, metavar="FOLDER", help="(default: out/pushing/TABLE-CONTROLLER-FIDELITY)")


def _register_real_pushes(kinds: Any) -> None:
    help = "three models of friction on the real pushes of Zhou et al. (2016)"
    add = add_command(kinds, "real-pushes", run_real_pushes, help=help).add_argument
    add("folder", type=Path, metavar="FOLDER|FILE", help="files named after what the block stands on")
    add("--out", type=Path, metavar="FOLDER", help="(default: out/real-pushes)")


def run_real_pushes(arguments: argparse.Namespace) -> int:
    """Predict the motion of a pushed block by its measured load, and where each push leaves it.

    The latter by the finger's way alone; with an ellipsoid, points of support, and a convex polynomial that
    is fitted to other pushes. Medians with 95 % intervals by the bootstrap.
    """
    files = [arguments.folder] if arguments.folder.is_file() else sorted(arguments.folder.glob("*.txt"))
    if not files:
        raise ValueError(f"{arguments.folder}: holds no pushes: must be files as patch.txt, or one of them")
    folder = arguments.out or Path("out") / "real-pushes"
    check_folder(folder)
    found = results.results_of_files(files)
    shown = number_table("real pushes: medians [95 %]", results.COLUMNS, box=box.SIMPLE_HEAD)
    console = wide_console()
    for result in found:
        shown.add_row(*results.cells(result))
    console.print(shown)
    for path in results.write_results(folder, found):
        say(console, str(path))
    return 0


def _register_offsets(kinds: Any) -> None:
    help = "constant offsets of the sensors that explain the paper's tables of pushing"
    parser = add_command(kinds, "offsets", run_offsets, help=help)
    add = parser.add_argument
    add("--trials", type=positive_int, default=2, metavar="N", help="of each row (2)")
    add_job_options(parser)
    add("--out", type=Path, metavar="FOLDER", help="(default: out/offsets)")


def run_offsets(arguments: argparse.Namespace) -> int:
    """Fit how the sensors of a cell stand in their tools to the means of the paper's tables of pushing.

    One cell made the table of one arm, another both of two. All rows of a cell have the same offsets, which
    its arms do not know of; nothing else is drawn; fidelity plane. With them also our controllers.
    """
    folder = arguments.out or Path("out") / "offsets"
    check_folder(folder)
    workers, console, fits = workers_of(arguments), wide_console(), {}
    folder.mkdir(parents=True, exist_ok=True)
    for name, (tables, names) in CELLS.items():
        with Progress() as progress:
            run = functools.partial(_plane_rows, workers, progress)
            rows, *others = (
                Rows(tables, names, run, controller, range(arguments.trials))
                for controller in ("paper", "tuned", "offset")
            )
            fit = fit_offsets(rows)
            place = tuple(fit.offsets.values())
            means = {other.controller: other.means([place])[0] for other in others}
        fits[name] = fit
        columns, lines = fit_lines(fit, means)
        shown = number_table(f"{name}: mean errors", columns, box=box.SIMPLE_HEAD)
        for line in lines:
            shown.add_row(*map(cell, line))
        console.print(shown)
        for sentence in fit.words():
            say(console, sentence)
        with whole_file(folder / f"{name.replace(' ', '_')}.md") as temporary:
            temporary.write_text(markdown(columns, lines))
    with whole_file(folder / "offsets.json") as temporary:
        temporary.write_text(json.dumps({name: fit.offsets for name, fit in fits.items()}, indent=2))
    say(console, str(folder))
    return 0


def _plane_rows(workers: Workers, progress: Progress, trials: list[Trial]) -> list[Row]:
    """The rows of trials, run in the plane."""
    found: dict[Trial, Row] = {}
    jobs = batches(trials, at_once=max(1, min(SIDE_BY_SIDE, -(-len(trials) // workers.processes))))
    for done in progress.counted(
        run_jobs(plane_rows, jobs, workers, progress.say), "pushes", len(jobs), "jobs"
    ):
        found.update(zip(done.job.trials, done.result(), strict=True))
    return [found[trial] for trial in trials]


def run(arguments: argparse.Namespace) -> int:
    """Run trials of pushing without ROS, on all cores or a cluster; make the paper's table of them or a map.

    The same command goes on after an interruption: each trial is kept as a line of trials.jsonl and is not
    done again.
    """
    table, trials_of = _asked(arguments)
    fidelity = arguments.fidelity or (map_of(arguments.map).fidelity if arguments.map else IDEAL)
    common = Common(
        table,
        arguments.controller,
        fidelity,
        arguments.filter,
        arguments.latency,
        tuple(arguments.changes),
        arguments.arm,
    )
    names = arguments.map or table, arguments.controller, fidelity
    folder = arguments.out or Path("out") / "pushing" / "-".join(names)
    check_folder(folder)
    first, count = arguments.seed, arguments.trials
    if arguments.trial is not None:
        if common.fidelity == PLANE:
            raise ValueError("--trial: the plane keeps no record to look at; choose --fidelity ideal")
        return _look_at(_named(trials_of, common, arguments.trial), folder)
    trials = trials_of(common, range(first, first + count))
    try:
        rows = _run_missing(trials, common, folder, arguments)
    except KeyboardInterrupt:
        Console(stderr=True).print("interrupted; the same command goes on from here")
        return 130
    return _deliver(arguments, trials, rows, folder)


def _asked(arguments: argparse.Namespace) -> tuple[str, Any]:
    """The table, and what makes trials from what they have in common and their numbers."""
    if arguments.map is not None:
        chosen = map_of(arguments.map)
        if arguments.objects or arguments.floors:
            raise ValueError("--objects and --floors are of --table: a map says which row it varies")
        row, places = (chosen.object, chosen.floor), chosen.places()
        table_of(chosen.table).rows([row[0]], [row[1]])
        return chosen.table, lambda common, numbers: [
            Trial(common, *row, number, place) for place in places for number in numbers
        ]
    rows = table_of(arguments.table).rows(arguments.objects, arguments.floors)
    return arguments.table, lambda common, numbers: [
        Trial(common, *row, number) for row in rows for number in numbers
    ]


def _named(trials_of: Any, common: Common, name: str) -> list[Trial]:
    number = name.rpartition("/")[2]
    trials: list[Trial] = trials_of(common, [int(number)]) if number.isdecimal() else []
    chosen = [trial for trial in trials if name in (number, trial.name)]
    if not chosen:
        example = trials_of(common, [3])[0].name
        raise ValueError(f"--trial {name}: must be a number from 0 on, or a trial's name, as {example}")
    return chosen


def _run_missing(
    trials: list[Trial], common: Common, folder: Path, arguments: argparse.Namespace
) -> list[Row]:
    """Run what is not done yet; the rows of all."""
    check_trial(trials[0])
    array_math(arguments.device)
    check_same_run(folder, {"experiment": arguments.what, **dataclasses.asdict(common)})
    rows = JobRows(folder / "trials.jsonl")
    missing = rows.missing(trials)
    with only_writer(folder), Progress() as progress:
        if len(missing) < len(trials):
            progress.say(f"{len(trials) - len(missing)} of {len(trials)} trials are done already")
        workers, tell = workers_of(arguments), progress.say
        made: Iterator[Row]
        if common.fidelity == PLANE:
            jobs = batches(missing, arguments.device)
            made = (row for done in run_jobs(plane_rows, jobs, workers, tell) for row in done.result())
        else:
            made = (done.result() for done in run_jobs(trial_row, missing, workers, tell))
        for row in progress.counted(made, "trials", len(missing), "trials"):
            rows.add(row)
    return rows.of(trials)


def _look_at(trials: list[Trial], folder: Path) -> int:
    codes = [deliver(trial_run(trial), folder / trial.name.replace("/", "-")) for trial in trials]
    return max(codes)


def _deliver(arguments: argparse.Namespace, trials: list[Trial], rows: list[Row], folder: Path) -> int:
    """Tables and pictures; the exit code is 1 where a trial did not come to its target."""
    console = wide_console()
    for line in failures(rows):
        say(console, line, "yellow")
    if arguments.map is not None:
        paths = write_map(folder, map_of(arguments.map), rows, trials)
    else:
        table = table_of(arguments.table)
        shown = number_table(f"{table.title}: final target error", COLUMNS, box=box.SIMPLE_HEAD)
        shown.columns[0].no_wrap = True
        for cells in table_rows(table, rows):
            shown.add_row(*map(cell, cells))
        console.print(shown)
        paths = write_table(folder, table, rows, trials[0].common)
    for path in (folder / "trials.jsonl", *paths):
        say(console, str(path))
    return 0 if all(row["succeeded"] for row in rows) else 1
