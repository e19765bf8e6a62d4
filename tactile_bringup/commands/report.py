"""`tactile report RUN`: numbers, pictures and a page of a run, recorded or simulated."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console

from tactile_base.console import number_table, say
from tactile_base.whole_file import room_for_results
from tactile_bringup.commands.changes import add_command
from tactile_records.runs.from_bag import read_runs
from tactile_records.runs.page import NAME, write_report_page
from tactile_records.runs.report import FILES, Run, places, summary, write_reports


def register(subparsers: Any) -> None:
    add = add_command(subparsers, "report", run, __doc__).add_argument
    add("run_of", type=Path, metavar="BAG|RUN", help="a recording, or the folder or run.npz of simulate")
    add("--out", type=Path, metavar="FOLDER", help="for report.html, report.json, pictures (NAME-report)")


def run(arguments: argparse.Namespace) -> int:
    source: Path = arguments.run_of
    name = source.stem if source.is_file() else source.name
    folder = arguments.out or source.with_name(f"{name}-report")
    room_for_results(folder, *FILES, source=source)
    return 0 if deliver(read_runs(source), source, folder, Console()) else 1


def deliver(records: Run, source: Path, folder: Path, console: Console) -> bool:
    """Write report and pictures of each arm, and print what a person wants to see first.

    Returns whether all arms have done what they were asked to, by the numbers of their reports.
    """
    values = write_reports(records, folder)
    write_report_page(records, values, folder)
    first = next(iter(records.values()))
    how = "simulated" if first.source == "offline" else "real ROS nodes"
    title = f"{first.task_file} on {first.scene}, {how}, seed {first.seed}"
    table = number_table(title, ["", "measured", "wanted"])
    for row in summary(records, values):
        table.add_row(*row)
    console.print(table)
    for record in records.values():
        for problem in ("bag_problem", "surface_problem"):
            if problem in record.result:
                say(console, f"note: {record.result[problem]}", "yellow")
    files = [path for place in places(records, folder).values() for path in sorted(place.glob("*.*"))]
    for path in (folder / NAME, *(path for path in files if path.suffix in (".json", ".png")), source):
        say(console, _short(path))
    return bool(values) and all(numbers["succeeded"] for numbers in values.values())


def _short(path: Path) -> str:
    """As one would type it from here."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)
