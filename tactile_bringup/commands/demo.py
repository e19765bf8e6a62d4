"""`tactile demo`: follows the ramp with real nodes, records it, shows the result in numbers and pictures."""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_bringup.commands.launch import EXIT_CODES, add_scene_options

if TYPE_CHECKING:
    from rich.console import Console

    from tactile_bringup.launching.launcher import Outcome
    from tactile_records.runs.record import RunRecord

TASK = "surface_following"
BAG, REPORT, MARKER = "bag", "report.json", "metadata.yaml"


def register(subparsers: Any) -> None:
    """Add `demo`."""
    parser = subparsers.add_parser(
        "demo",
        help="follow a curved ramp in simulation, with pictures",
        description=__doc__,
        epilog=EXIT_CODES,
    )
    add_scene_options(parser)
    parser.add_argument(
        "--out", type=Path, default=Path("out/demo"), metavar="FOLDER", help="(default: out/demo)"
    )
    parser.add_argument("--record-images", action="store_true", help="images into the bag as well")
    parser.add_argument("--headless", action="store_true", help="plain lines in place of the live display")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit code."""
    from rich.console import Console

    from tactile_bringup.commands.launch import launch
    from tactile_bringup.graph import GraphOptions

    console, folder = Console(), arguments.out.absolute()
    bag = folder / BAG
    if not _make_room(bag):
        return 2
    model = arguments.model.absolute() if arguments.model else None
    options = GraphOptions(arguments.rate, arguments.seed, model, bag, arguments.record_images)
    outcome = launch(TASK, arguments.scene, options, folder, console, arguments.headless)
    if outcome is None:
        return 2
    if not bag.is_dir():
        return outcome.exit_code or 1
    return _deliver(bag, folder, outcome, console)


def _make_room(bag: Path) -> bool:
    """Remove the bag of the last demo, and only that."""
    if bag.exists() and not (bag / MARKER).is_file():
        print(f"tactile demo: {bag} exists and is no bag; remove it or use --out elsewhere", file=sys.stderr)
        return False
    if bag.exists():
        shutil.rmtree(bag)
    return True


def _deliver(bag: Path, folder: Path, outcome: Outcome, console: Console) -> int:
    """Report, pictures and summary of each arm, also of a run that failed as far as it went."""
    from tactile_records.bags.reader import read_bag
    from tactile_records.bags.writer import BagError
    from tactile_records.runs.from_bag import arms_of, run_from_bag

    try:
        recorded = read_bag(bag)
        records = [run_from_bag(recorded, arm) for arm in arms_of(recorded)] or [run_from_bag(recorded)]
    except (BagError, ValueError) as error:
        print(f"tactile demo: no report: {error}", file=sys.stderr)
        return outcome.exit_code or 1
    for record in records:
        if outcome.exit_code:
            record.result |= {"succeeded": False, "reason": outcome.reason.splitlines()[0]}
        _write(record, bag, folder / record.arm if len(records) > 1 else folder, console)
    return outcome.exit_code or (0 if all(record.result["succeeded"] for record in records) else 1)


def _write(record: RunRecord, bag: Path, folder: Path, console: Console) -> None:
    from rich.table import Table

    from tactile_records.runs.figures import write_figures
    from tactile_records.runs.metrics import summary_rows, write_report

    folder.mkdir(parents=True, exist_ok=True)
    values = write_report(record, folder / REPORT)
    pictures = write_figures(record, folder)
    table = Table(title=f"{record.task} on {record.scene}, {record.arm}, real ROS nodes, seed {record.seed}")
    for name in ("", "measured", "wanted"):
        table.add_column(name, justify="left" if not name else "right")
    for row in summary_rows(values):
        table.add_row(*row)
    console.print(table)
    for problem in ("bag_problem", "surface_problem"):
        if problem in record.result:
            console.print(f"note: {record.result[problem]}", style="yellow", highlight=False)
    for path in (folder / REPORT, *pictures, bag):
        console.print(_short(path), highlight=False, soft_wrap=True)


def _short(path: Path) -> str:
    """As one would type it from here."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)
