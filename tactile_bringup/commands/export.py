"""Write recordings, or runs of `simulate`, for other tools.

Poses, estimates, beliefs with covariance, truth, commands and latency of each arm as tables, whose columns
end in their unit, or trajectories as evo reads them; or recordings with images as one LeRobot data set, an
episode each.
"""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path
from typing import Any

from tactile_base.console import lasting_console, say
from tactile_base.whole_file import check_folder
from tactile_bringup.commands.changes import add_command, positive_int
from tactile_records.runs import export
from tactile_records.runs.from_bag import read_runs
from tactile_records.runs.lerobot import write_dataset
from tactile_records.runs.record import RunRecord

FORMATS = ("csv", "parquet", "tum", "lerobot")


def register(subparsers: Any) -> None:
    epilog = "exit codes: 0 written, 2 nothing written"
    add = add_command(subparsers, "export", run, __doc__, epilog=epilog).add_argument
    add("runs_of", type=Path, nargs="+", metavar="BAG|RUN", help="a recording, or run.npz of simulate")
    add("--as", dest="form", choices=FORMATS, default="csv", help="(csv)")
    add("--fps", type=positive_int, help="of lerobot: frames a second (default: the first camera's)")
    add("--out", type=Path, metavar="FOLDER", help="(default: beside it, its name with -export)")


def run(arguments: argparse.Namespace) -> int:
    form, sources = arguments.form, arguments.runs_of
    if form in ("parquet", "lerobot") and importlib.util.find_spec("pyarrow") is None:
        raise ValueError(f"--as {form} needs pyarrow: pip install pyarrow; --as csv needs nothing")
    folder = arguments.out or sources[0].with_name(f"{sources[0].stem}-export")
    check_folder(folder)
    if form == "lerobot":
        if folder.exists() and any(folder.iterdir()):
            raise ValueError(f"{folder}: is not empty; a data set of its own needs a folder of its own")
        for line in write_dataset(sources, folder, arguments.fps):
            say(lasting_console(), line)
        return 0
    if len(sources) > 1:
        raise ValueError(f"--as {form} writes one run; lerobot takes several, an episode each")
    for arm, record in read_runs(sources[0]).items():
        for file in _write(record, form, folder / arm):
            say(lasting_console(), str(file))
    return 0


def _write(record: RunRecord, form: str, folder: Path) -> list[Path]:

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
