"""`tactile data check`: what is in a data folder, how its labels are spread, which conventions it follows."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from tactile_base.console import number_table, say
from tactile_base.progress import Progress
from tactile_base.whole_file import room_for_results
from tactile_bringup.commands.changes import add_command
from tactile_perception.datasets import check_plots
from tactile_perception.datasets.check import CheckResult, check
from tactile_perception.datasets.dataset import open_folder
from tactile_perception.datasets.layout import data_folders
from tactile_perception.datasets.table import CONVENTIONS_NAME, ConventionSettings
from tactile_perception.estimating.image import handful
from tactile_perception.estimating.labels import EULER_COMPONENTS, EULER_TITLES
from tactile_perception.markers.flow import FlowSettings

EXIT_CODES = """exit codes: 0 nothing wrong was found (warnings are no error, but see --strict);
1 labels or images are wrong; 2 the folder cannot be read as a data set"""
STYLES = {"ok": "green", "note": "cyan", "warning": "yellow", "error": "red"}


def register(commands: Any) -> None:
    help = "ranges, coverage, signs and frames of a data set"
    add = add_command(commands, "check", run, __doc__, help=help, epilog=EXIT_CODES).add_argument
    add("folder", type=Path, help="data folder, or one of parts (train, val)")
    add("--out", type=Path, metavar="DIR", help="write pictures and check.json there")
    add("--samples", type=int, default=1000, metavar="N", help="images in which markers are followed (1000)")
    add("--seed", type=int, default=0, help="of their choice")
    add("--strict", action="store_true", help="end with exit code 1 for warnings too")
    text = "where signs or units are others and there is one way to correct them, write conventions.json"
    add("--write-conventions", action="store_true", help=text)


def run(arguments: argparse.Namespace) -> int:
    console = Console()
    settings = FlowSettings(samples=arguments.samples, seed=arguments.seed)
    if arguments.out is not None:
        room_for_results(arguments.out, "check.json", "*/check.json", source=arguments.folder)
    bad = ("error", "warning") if arguments.strict else ("error",)
    status = 0
    for part, path in data_folders(arguments.folder).items():
        folder = open_folder(path)
        with Progress() as progress:
            result = check(folder, settings, progress.update)
        if arguments.out is not None:
            _write(result, arguments.out / part)
        show(result, console)
        if arguments.out is not None:
            say(console, f"pictures and check.json: {arguments.out / part}")
        if arguments.write_conventions:
            say(console, write_conventions(result))
        status |= int(result.worst in bad)
    return status


def show(result: CheckResult, console: Console) -> None:
    """Ranges and findings as tables."""
    title = f"{result.folder.folder}: {len(result.folder)} samples"
    columns = ("component", "least", "largest", "mean", "deviation")
    ranges = number_table(title, columns, title_justify="left")
    for name, title, row in zip(EULER_COMPONENTS, EULER_TITLES, result.statistics.ranges, strict=True):
        labelled = name in result.folder.labelled
        ranges.add_row(title, *(f"{value:.3f}" if labelled else "-" for value in row))
    console.print(ranges)
    table = Table(show_header=False, box=None, pad_edge=False)
    for finding in result.findings:
        table.add_row(Text(finding.level, STYLES[finding.level]), finding.topic, Text(finding.text))
    console.print(table)
    counts = {level: sum(f.level == level for f in result.findings) for level in STYLES}
    say(console, ", ".join(f"{count} {level}" for level, count in counts.items()))


def write_conventions(result: CheckResult) -> str:
    """Write `conventions.json` if there is one way to correct the labels; returns what was done, in words."""
    found = result.conventions
    path = result.folder.folder / CONVENTIONS_NAME
    if found is None or path.exists():
        return f"{path}: not written, since " + ("it is there already" if found else "images tell nothing")
    if not found.wrong:
        return f"{path}: not needed" + (", as far as images tell" if found.uncertain else "")
    contents = [json.dumps(content) for content, _ in found.corrections(ConventionSettings())]
    if len(contents) != 1:
        listed = "; or ".join(contents) or "none"
        return f"{path}: not written, since there is not one way to correct the signs (found: {listed})"
    path.write_text(contents[0] + "\n")
    return f"{path}: written; every reader applies it from now on: {contents[0]}"


def _write(result: CheckResult, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    check_plots.draw_labels(result, folder / "labels.png")
    check_plots.draw_rows(result, folder / "rows.png")
    check_plots.draw_flow(result, folder / "flow.png")
    _draw_inputs(result, folder / "inputs.png")
    content = {
        "folder": str(result.folder.folder),
        "samples": len(result.folder),
        "worst": result.worst,
        "findings": [vars(finding) for finding in result.findings],
        "shows": result.visibility.shares if result.visibility else {},
        "noise": result.visibility.noise if result.visibility else math.nan,
        "gains": result.conventions.gains if result.conventions else {},
        "camera_deg": result.conventions.camera_deg if result.conventions else math.nan,
    }
    (folder / "check.json").write_text(json.dumps(content, indent=2) + "\n")


def _draw_inputs(result: CheckResult, path: Path) -> None:
    """What a network sees of some camera images; of processed ones that is to be seen in their folder."""
    folder = result.folder
    if not folder.processed and (images := handful(folder.image_folder, folder.names, folder.kind)):
        check_plots.draw_inputs(images, folder.preprocessing, path, folder.reference())
