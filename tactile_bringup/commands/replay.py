"""Run the estimates and transforms of a bag (MCAP or sqlite3, ours or of `ros2 bag`) through the filter.

Writes a bag, a table and a picture that compares the runs.
"""

from __future__ import annotations

import argparse
import os
import shutil
import time
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console

from tactile_base.config_paths import named_file
from tactile_base.console import number_table, say, wide_console
from tactile_base.progress import Progress
from tactile_base.version import version
from tactile_base.whole_file import room_for_results
from tactile_bringup.commands.changes import add_command, add_job_options, add_set_option, workers_of
from tactile_records.bags.contents import BagError
from tactile_records.bags.reader import Bag, read_bag
from tactile_records.replay.figures import compare
from tactile_records.replay.images import estimated, wanted_with_images
from tactile_records.replay.inputs import Inputs, inputs_of, read_inputs
from tactile_records.replay.kept import KeptRuns, Plan
from tactile_records.replay.report import TABLE, RunResult, numbers, table_row, write_report
from tactile_records.replay.sweep import Options, base_settings, make_plans, run_plans, same_settings
from tactile_records.replay.topics import ReplayError

EXIT_OK, EXIT_DIFFERS, EXIT_USAGE = 0, 1, 2
REPORT = "report.json"
NEW_FROM_IMAGES = ("/contact/estimate", "/contact/presence")


def register(subparsers: Any) -> None:
    epilog = "exit codes: 0 done, 1 with --check where beliefs are not the recorded ones, 2 nothing done"
    parser = add_command(subparsers, "replay", run, __doc__, epilog=epilog)
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="folder of a bag, or one of its files")
    add_set_option(parser, "change a setting of the filter")
    text = "one run for each value; given again: for each combination"
    add("--sweep", action="append", default=[], metavar="NAME=A,B,C", help=text)
    add("--filter", metavar="NAME|FILE", help="filter settings from a file, in place of the recorded ones")
    text = "what the filter takes: the recorded estimates, or new ones from the recorded images"
    add("--from", dest="source", choices=("estimates", "images"), default="estimates", help=text)
    add("--model", type=Path, help="with --from images: model (default: the recorded one, else the shipped)")
    add("--base", default="", metavar="FRAME", help="frame in which the surface rests (default: ARM/base)")
    add("--out", type=Path, help="folder for the results (default: out/replay/BAG)")
    add("--smooth", action="store_true", help="add beliefs that know what came later")
    add("--all-events", action="store_true", help="take what the live filter had dropped, too")
    add("--copy", choices=("inputs", "all"), help="put the filter's inputs, or all topics, into the new bag")
    add("--check", action="store_true", help="fail unless the beliefs are the recorded ones")
    add_job_options(parser, those="with --sweep: ")
    add("--no-plot", action="store_true", help="draw no pictures")


def run(arguments: argparse.Namespace) -> int:
    folder = arguments.out or Path("out") / "replay" / arguments.bag.resolve().stem
    started, busy = time.perf_counter(), _processor_time()
    inputs = _inputs(arguments)
    profile = None if arguments.filter is None else named_file("filter", arguments.filter)
    base = base_settings(inputs, profile)
    plans = make_plans(base, arguments.changes, arguments.sweep, folder, profile is not None)
    room_for_results(folder, REPORT, source=arguments.bag)
    kept = KeptRuns(folder, _same(arguments, inputs))
    _make_room(folder, [plan for plan in plans if kept.results(plan) is None])
    with Progress() as progress:
        options, workers = _options(arguments, inputs), workers_of(arguments)
        results = run_plans(plans, inputs, options, workers, progress, kept)
    seconds, busy = time.perf_counter() - started, _processor_time() - busy
    console = wide_console()
    agree = _deliver(arguments, folder, inputs, plans, results, console)
    kept.remove()
    speed = inputs.span_s * len(plans) / seconds if seconds else 0.0
    runs = f"{len(plans)} run{'s' * (len(plans) > 1)}"
    times = f"{inputs.span_s:.1f} s recorded, {runs} in {seconds:.2f} s ({busy:.2f} s of processor time)"
    say(console, f"{times}: {speed:.0f} times real time")
    return EXIT_OK if agree or not arguments.check else EXIT_DIFFERS


def _same(arguments: argparse.Namespace, inputs: Inputs) -> dict[str, Any]:
    """What runs of an interrupted sweep have to agree in, beside their settings, to be taken as they are."""
    inside = [arguments.bag] if arguments.bag.is_file() else inputs.bag.folder.iterdir()
    files = [path for path in (*inside, arguments.model) if path is not None and path.is_file()]
    states = {str(path): [path.stat().st_size, path.stat().st_mtime_ns] for path in files}
    options = ("bag", "source", "model", "base", "smooth", "all_events", "copy")
    return {
        "version": version(),
        "files": states,
        **{name: str(getattr(arguments, name)) for name in options},
    }


def _processor_time() -> float:
    """Of this process and of those that it has waited for, s."""
    return sum(os.times()[:4])


def _inputs(arguments: argparse.Namespace) -> Inputs:

    if arguments.source == "estimates":
        if arguments.model is not None:
            raise ReplayError("--model needs --from images: recorded estimates are taken as they are")
        return read_inputs(arguments.bag, arguments.base)

    bag, remarks = estimated(read_bag(arguments.bag, wanted_with_images), arguments.model)
    inputs = inputs_of(bag, arguments.base)
    inputs.remarks += remarks
    return inputs


def _options(arguments: argparse.Namespace, inputs: Inputs) -> Any:

    used = inputs.bag.messages
    if arguments.copy == "all":
        topics = {message.topic for message in used}
        used = used + [m for m in read_bag(arguments.bag).messages if m.topic not in topics]
    elif arguments.copy is None:
        used = [m for m in used if arguments.source == "images" and m.topic.endswith(NEW_FROM_IMAGES)]
    return Options(not arguments.all_events, arguments.smooth, used)


def _make_room(folder: Path, plans: list[Plan]) -> None:
    """Remove bags of former replays that are in the way, and only those."""
    for plan in plans:
        if not plan.bag.exists():
            continue
        old: Bag = read_bag(plan.bag, lambda topic, type_name: False)
        if "replay" not in old.note:
            raise BagError(
                f"{plan.bag} exists and was not written by a replay; remove it or use --out elsewhere"
            )
        shutil.rmtree(plan.bag)
    folder.mkdir(parents=True, exist_ok=True)


def _deliver(
    arguments: argparse.Namespace,
    folder: Path,
    inputs: Inputs,
    plans: list[Plan],
    results: list[list[RunResult]],
    console: Console,
) -> bool:
    """Tables, pictures and report; returns whether all beliefs are the recorded ones."""
    for remark in inputs.remarks:
        _note(console, remark)
    report: dict[str, Any] = {"bag": str(inputs.bag.folder), "remarks": inputs.remarks, "arms": {}}
    agree, paths = True, []
    for arm in inputs.arms:
        mine = [result for run in results for result in run if result.arm == arm.name]
        values = {result.name: numbers(result, arm.truth) for result in mine}
        report["arms"][arm.name] = {"remarks": arm.remarks, "runs": values}
        for remark in arm.remarks:
            _note(console, f"{arm.name}: {remark}")
        if arm.changes:
            text = f"{len(arm.changes)} changes of the filter's settings while it ran are followed"
            say(console, f"{arm.name}: {text}")
        if arm.resets:
            say(console, f"{arm.name}: {len(arm.resets)} resets by its service are followed")
        _print_table(console, arm.name, mine, values)
        agree &= _tell_agreement(console, inputs, arm, plans, mine)
        if not arguments.no_plot:
            paths.append(folder / (f"{arm.name}.png" if len(inputs.arms) > 1 else "replay.png"))
            compare(arm, mine, f"{inputs.bag.folder.name}, {arm.name}", paths[-1])
    write_report(folder / REPORT, report)
    for path in (folder / REPORT, *paths, *(plan.bag for plan in plans)):
        say(console, str(path))
    return agree


def _note(console: Console, text: str) -> None:
    say(console, f"note: {text}", "yellow")


def _print_table(console: Console, arm: str, results: list[RunResult], values: dict[str, Any]) -> None:

    title = f"{arm}: RMS errors against the truth (mm, deg), consistency, agreement with what was live"
    table = number_table(title, TABLE, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), title_justify="left")
    for column in table.columns:
        column.no_wrap = True
    for result in results:
        table.add_row(*table_row(result, values[result.name]))
    console.print(table)


def _tell_agreement(
    console: Console, inputs: Inputs, arm: Any, plans: list[Plan], results: list[RunResult]
) -> bool:
    """Say where a run with the recorded settings differs from what was live; whether none does."""
    agree = arm.live is not None
    for plan in plans:
        result = next(r for r in results if r.name == plan.name)
        found = result.agreement
        if found is None or not same_settings(plan, inputs, arm):
            agree = agree and found is not None and found.identical == found.common
            continue
        if found.identical < found.common:
            agree = False
            text = f"{found.common - found.identical} of {found.common} beliefs differ from the live ones"
            _note(console, f"{arm.name}: {text}, first in {found.first_difference}")
        else:
            say(console, f"{arm.name}: all {found.common} beliefs are those of the live filter, to the bit")
        if found.only_live:
            text = f"what {found.only_live} live beliefs were made from is not in the bag"
            text += f": {found.after_gap} after them cannot be compared" if found.after_gap else ""
            _note(console, f"{arm.name}: {text}")
        if result.left_out:
            text = f"{result.left_out} events were not taken, as the live filter did not take them either"
            _note(console, f"{arm.name}: {text} (--all-events takes them)")
    return agree
