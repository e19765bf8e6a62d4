"""`tactile demo`: runs a task with real nodes, records it, shows the result in numbers and pictures."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_base.whole_file import room_for_results
from tactile_bringup.commands.changes import refusing
from tactile_bringup.commands.launch import EXIT_CODES, TASK_HELP, add_scene_options, add_view_option

if TYPE_CHECKING:
    from rich.console import Console

    from tactile_bringup.launching.launcher import Outcome

TASK = "surface_following"
BAG, MARKER = "bag", "metadata.yaml"


def register(subparsers: Any) -> None:
    """Add `demo`."""
    doc = "follow a curved ramp in simulation, or run another task, with pictures"
    parser = subparsers.add_parser("demo", help=doc, description=__doc__, epilog=EXIT_CODES)
    add = parser.add_argument
    add("task", nargs="?", default=TASK, help=f"{TASK_HELP} (default: {TASK})")
    add_scene_options(parser)
    add("--out", type=Path, default=Path("out/demo"), metavar="FOLDER", help="(default: out/demo)")
    add("--record-images", action="store_true", help="images into the bag as well")
    add("--headless", action="store_true", help="plain lines in place of the live display")
    add_view_option(parser)
    parser.set_defaults(run=run)


@refusing("demo", status=2)
def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit code."""
    from tactile_base.console import lasting_console
    from tactile_bringup.commands.launch import graph_options, launch
    from tactile_bringup.launching.launcher import Manner

    console, folder = lasting_console(), arguments.out.absolute()
    bag = folder / BAG
    room_for_results(folder, f"{BAG}/{MARKER}")
    options = graph_options(arguments, record=bag)
    manner = Manner("demo", arguments.headless, view=arguments.view)
    outcome = launch(arguments.task, arguments.scene, options, folder, console, manner)
    if outcome is None:
        return 2
    if not bag.is_dir():
        return outcome.exit_code or 1
    return _deliver(bag, folder, outcome, console)


def _deliver(bag: Path, folder: Path, outcome: Outcome, console: Console) -> int:
    """Report, pictures and summary of each arm, also of a run that failed as far as it went."""
    from tactile_bringup.commands.report import deliver
    from tactile_records.bags.writer import BagError
    from tactile_records.runs.from_bag import read_arms

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
