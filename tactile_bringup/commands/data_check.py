"""`tactile data check`: what is in a data folder, how its labels are spread, which conventions it follows."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from tactile_base.console import number_table, say
from tactile_base.progress import Progress
from tactile_base.whole_file import room_for_results
from tactile_bringup.commands.changes import refusing
from tactile_perception.estimating.labels import EULER_TITLES

if TYPE_CHECKING:
    from tactile_perception.datasets.check import CheckResult

EXIT_CODES = """exit codes: 0 nothing wrong was found (warnings are no error, but see --strict);
1 labels or images are wrong; 2 the folder cannot be read as a data set"""
STYLES = {"ok": "green", "note": "cyan", "warning": "yellow", "error": "red"}


def register(commands: Any) -> None:
    """Add `check` to the subparsers of `tactile data`."""
    parser = commands.add_parser(
        "check", help="ranges, coverage, signs and frames of a data set", description=__doc__,
        epilog=EXIT_CODES,
    )  # fmt: skip
    add = parser.add_argument
    add("folder", type=Path, help="data folder")
    add("--out", type=Path, metavar="DIR", help="write pictures and check.json there")
    add("--samples", type=int, default=1000, metavar="N", help="images in which markers are followed (1000)")
    add("--seed", type=int, default=0, help="of their choice")
    add("--strict", action="store_true", help="end with exit code 1 for warnings too")
    add("--write-conventions", action="store_true",
        help="where signs or units are others and there is one way to correct them, write conventions.json",
    )  # fmt: skip
    parser.set_defaults(run=run)


@refusing("data check", status=2)
def run(arguments: argparse.Namespace) -> int:
    """`tactile data check`: returns the exit status."""
    from tactile_perception.datasets.check import check
    from tactile_perception.datasets.dataset import open_folder
    from tactile_perception.markers.flow import FlowSettings

    console = Console()
    if arguments.out is not None:
        room_for_results(arguments.out, "check.json", source=arguments.folder)
    folder = open_folder(arguments.folder)
    settings = FlowSettings(samples=arguments.samples, seed=arguments.seed)
    with Progress() as progress:
        result = check(folder, settings, progress.update)
    if arguments.out is not None:
        _write(result, arguments.out)
    show(result, console)
    if arguments.out is not None:
        say(console, f"pictures and check.json: {arguments.out}")
    if arguments.write_conventions:
        say(console, write_conventions(result))
    bad = ("error", "warning") if arguments.strict else ("error",)
    return int(result.worst in bad)


def show(result: CheckResult, console: Console) -> None:
    """Ranges and findings as tables."""
    title = f"{result.folder.folder}: {len(result.folder)} samples"
    columns = ("component", "least", "largest", "mean", "deviation")
    ranges = number_table(title, columns, title_justify="left")
    for name, row in zip(EULER_TITLES, result.statistics.ranges, strict=True):
        ranges.add_row(name, *(f"{value:.3f}" for value in row))
    console.print(ranges)
    table = Table(show_header=False, box=None, pad_edge=False)
    for finding in result.findings:
        table.add_row(Text(finding.level, STYLES[finding.level]), finding.topic, Text(finding.text))
    console.print(table)
    counts = {level: sum(f.level == level for f in result.findings) for level in STYLES}
    say(console, ", ".join(f"{count} {level}" for level, count in counts.items()))


def write_conventions(result: CheckResult) -> str:
    """Write `conventions.json` if there is one way to correct the labels; returns what was done, in words."""
    from tactile_perception.datasets.table import CONVENTIONS_NAME

    found = result.conventions
    path = result.folder.folder / CONVENTIONS_NAME
    if found is None or path.exists():
        return f"{path}: not written, since " + ("it is there already" if found else "images tell nothing")
    ways = [way for way in found.explanations if not way.swapped and not way.mirrored]
    if len(ways) != 1:
        listed = "; ".join(map(str, found.explanations)) or "none"
        return f"{path}: not written, since there is not one way to correct the signs (found: {listed})"
    flip = [*ways[0].flipped, *(["z"] if found.depth_flipped else [])]
    content = {
        "flip": flip,
        "length_unit": found.length_unit or "mm",
        "angle_unit": found.angle_unit or "deg",
    }
    if not flip and content["length_unit"] == "mm" and content["angle_unit"] == "deg":
        return f"{path}: not needed"
    path.write_text(json.dumps(content) + "\n")
    return f"{path}: written; every reader applies it from now on: {json.dumps(content)}"


def _write(result: CheckResult, folder: Path) -> None:
    from tactile_perception.datasets import check_plots

    folder.mkdir(parents=True, exist_ok=True)
    check_plots.draw_labels(result, folder / "labels.png")
    check_plots.draw_rows(result, folder / "rows.png")
    check_plots.draw_flow(result, folder / "flow.png")
    content = {
        "folder": str(result.folder.folder),
        "samples": len(result.folder),
        "worst": result.worst,
        "findings": [vars(finding) for finding in result.findings],
        "gains": result.conventions.gains if result.conventions else {},
        "camera_deg": result.conventions.camera_deg if result.conventions else math.nan,
    }
    (folder / "check.json").write_text(json.dumps(content, indent=2) + "\n")
