"""`tactile export`: a recording, or the run of `simulate`, as tables for other tools."""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_bringup.commands.changes import refusing

if TYPE_CHECKING:
    from tactile_records.runs.record import RunRecord

FORMATS = ("csv", "parquet", "tum")


def register(subparsers: Any) -> None:
    """Add `export`."""
    parser = subparsers.add_parser(
        "export",
        help="a recording as CSV, Parquet or TUM trajectories, for pandas, PlotJuggler and evo",
        description="Write poses, estimates, beliefs with covariance, truth, commands and latency of each "
        "arm as tables, whose columns end in their unit, or trajectories as evo reads them.",
        epilog="Exit codes: 0 written, 2 nothing written.",
    )
    add = parser.add_argument
    add("run_of", type=Path, metavar="BAG|RUN", help="a recording, or run.npz of simulate")
    add("--as", dest="form", choices=FORMATS, default="csv", help="(csv)")
    add("--out", type=Path, metavar="FOLDER", help="(default: beside it, its name with -export)")
    parser.set_defaults(run=run)


@refusing("export", status=2)
def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit code."""
    from tactile_base.console import lasting_console, say
    from tactile_base.whole_file import check_folder
    from tactile_records.runs.read_runs import read_runs

    if arguments.form == "parquet" and importlib.util.find_spec("pyarrow") is None:
        raise ValueError("--as parquet needs pyarrow: pip install pyarrow; --as csv needs nothing")
    source: Path = arguments.run_of
    folder = arguments.out or source.with_name(f"{source.stem}-export")
    check_folder(folder)
    for arm, record in read_runs(source).items():
        for file in _write(record, arguments.form, folder / arm):
            say(lasting_console(), str(file))
    return 0


def _write(record: RunRecord, form: str, folder: Path) -> list[Path]:
    from tactile_records.runs import export

    folder.mkdir(parents=True, exist_ok=True)
    files = []
    if form == "tum":
        for name, (stamps, poses) in export.trajectories(record).items():
            files.append(folder / f"{name}.tum")
            export.write_tum(stamps, poses, files[-1])
        return files
    write = export.write_csv if form == "csv" else export.write_parquet
    for name, table in export.tables(record).items():
        files.append(folder / f"{name}.{form}")
        write(table, files[-1])
    return files
