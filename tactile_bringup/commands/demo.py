"""`tactile demo`: runs a task with real nodes, records it, shows the result in numbers and pictures."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from tactile_base.console import lasting_console
from tactile_base.whole_file import room_for_results
from tactile_bringup.commands.changes import add_command
from tactile_bringup.commands.launch import (
    EXIT_CODES,
    TASK_HELP,
    add_scene_options,
    add_view_option,
    graph_options,
    launch,
)
from tactile_bringup.commands.report import deliver
from tactile_records.bags.writer import BagError
from tactile_records.runs.from_bag import read_arms

if TYPE_CHECKING:
    from tactile_bringup.launching.launcher import Outcome

TASK = "surface_following"
BAG, MARKER = "bag", "metadata.yaml"


def register(subparsers: Any) -> None:
    parser = add_command(subparsers, "demo", run, __doc__, epilog=EXIT_CODES)
    add = parser.add_argument
    add("task", nargs="?", default=TASK, help=f"{TASK_HELP} (default: {TASK})")
    add_scene_options(parser)
    add("--out", type=Path, default=Path("out/demo"), metavar="FOLDER", help="(default: out/demo)")
    add("--record-images", action="store_true", help="images into the bag as well")
    add("--headless", action="store_true", help="plain lines in place of the live display")
    add_view_option(parser)


def run(arguments: argparse.Namespace) -> int:
    from tactile_bringup.launching.launcher import Manner

    console, folder = lasting_console(), arguments.out.absolute()
    bag = folder / BAG
    room_for_results(folder, f"{BAG}/{MARKER}")
    options = graph_options(arguments, record=bag)
    manner = Manner("demo", arguments.headless, view=arguments.view)
    outcome = launch(arguments.task, arguments.scene, options, folder, console, manner)
    if not bag.is_dir():
        return outcome.exit_code or 1
    return _deliver(bag, folder, outcome, console)


def _deliver(bag: Path, folder: Path, outcome: Outcome, console: Console) -> int:
    """Report, pictures and summary of each arm, also of a run that failed as far as it went."""
    try:
        run = read_arms(bag)
    except (BagError, ValueError) as error:
        print(f"tactile demo: no report: {error}", file=sys.stderr)
        return outcome.exit_code or 1
    for record in run.values():
        if outcome.exit_code:
            record.result |= {"succeeded": False, "reason": outcome.reason.splitlines()[0]}
    well = deliver(run, bag, folder, console)
    return outcome.exit_code or (0 if well else 1)
