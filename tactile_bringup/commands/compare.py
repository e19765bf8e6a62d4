"""Compare recordings, what simulate wrote, or folders with report.json.

Runs that differ by their seeds alone are a group; groups are held against the first.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import Any

from rich.console import Console

from tactile_base.console import number_table, say
from tactile_base.whole_file import room_for_results
from tactile_bringup.commands.changes import add_command
from tactile_records.runs.comparison import read_compared
from tactile_records.runs.comparison_page import (
    NUMBERS,
    Comparison,
    compared,
    doubt,
    spread,
    summary,
    write_comparison,
)

MOST_ROWS = 25


def register(subparsers: Any) -> None:
    epilog = "exit codes: 0 written, 2 nothing written"
    add = add_command(subparsers, "compare", run, __doc__, epilog=epilog).add_argument
    add("runs", type=Path, nargs="+", metavar="RUN", help="at least two; a group of several is better")
    add("--out", type=Path, metavar="FOLDER", default=Path("out/compare"), help="(default: out/compare)")


def run(arguments: argparse.Namespace) -> int:
    if len(arguments.runs) < 2:
        raise ValueError("one run is nothing to compare; name two or more")
    runs = read_compared(arguments.runs)
    times = Counter(run.arm for run in runs)
    found = compared([run for run in runs if times[run.arm] > 1])
    if not found:
        raise ValueError(f"no arm is in more than one of these runs ({', '.join(times)}): nothing to compare")
    room_for_results(arguments.out, NUMBERS)
    console = Console()
    for one in found:
        _show(one, console)
    for path in write_comparison(found, arguments.out):
        say(console, str(path))
    return 0


def _show(one: Comparison, console: Console) -> None:

    for group in one.groups:
        say(console, f"{one.arm}, group {group.name}: {', '.join(run.source for run in group.runs)}")
    for name, values in one.settings.items():
        told = (f"{group.name} {value}" for group, value in zip(one.groups, values, strict=True))
        say(console, f"  {name}: {', '.join(told)}")
    if one.untold:
        say(console, f"  {doubt(one)}", "yellow")
    if len(one.groups) == 1:
        say(console, "  all of them are of one kind: the page shows how their numbers are spread")
        return
    say(console, f"  {summary(one)}")
    if one.larger:
        runs = {group.name: len(group.runs) for group in one.groups}
        table = number_table("", ["", "group", one.groups[0].name, "that group", "difference"])
        for difference in one.larger[:MOST_ROWS]:
            pair = (one.groups[0].name, difference.first), (difference.group, difference.second)
            cells = (spread(found, runs[name]) for name, found in pair)
            table.add_row(difference.number, difference.group, *cells, f"{difference.size:+.3g}")
        table.columns[0].overflow = "fold"
        console.print(table)
    if len(one.larger) > MOST_ROWS:
        say(console, f"  and {len(one.larger) - MOST_ROWS} more, on the page")
