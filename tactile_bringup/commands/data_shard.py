"""Bring data sets that no memory holds into shards, Parquet files of some thousand samples in random order.

Every command that reads data folders reads them too, and `tactile train` streams what does not fit into
memory, on one machine or, started by torchrun, on many. Shards are copies: the folders may go. The same
command goes on after an interruption.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console

from tactile_base.console import say
from tactile_base.progress import Progress
from tactile_bringup.commands.changes import add_command, natural_int, positive_int
from tactile_perception.datasets.layout import DatasetError, data_folders
from tactile_perception.datasets.sharding import FILE_ROWS, GROUP_ROWS, ShardSettings, write_shards


def register(commands: Any) -> None:
    help = "copy data sets into shards, to train on more than fits into memory"
    add = add_command(commands, "shard", run, __doc__, help=help, status=1).add_argument
    add("folders", type=Path, nargs="+", metavar="FOLDER", help="data folder, or one of parts (train, val)")
    add("--out", type=Path, required=True, metavar="DIR", help="folder for the shards, or their parts")
    text = "names the files: another one, to add a data set to those in DIR (shard)"
    add("--name", default="shard", metavar="NAME", help=text)
    text = f"samples that are read, and mixed with others, together ({GROUP_ROWS})"
    add("--group", type=positive_int, default=GROUP_ROWS, metavar="N", help=text)
    add("--file", type=positive_int, default=FILE_ROWS, metavar="N", help=f"samples in a file ({FILE_ROWS})")
    add("--seed", type=natural_int, default=0, help="of the order")


def run(arguments: argparse.Namespace) -> int:
    console = Console()
    settings = ShardSettings(arguments.name, arguments.group, arguments.file, arguments.seed)
    parts: dict[str, list[Path]] = {}
    for folder in arguments.folders:
        for part, path in data_folders(folder).items():
            parts.setdefault(part, []).append(path)
    if "" in parts and len(parts) > 1:
        raise DatasetError(f"{parts[''][0]} has no parts such as train/, other folders have: name parts")
    for part, sources in parts.items():
        _shard(sources, arguments.out / part, settings, console)
    return 0


def _shard(sources: list[Path], out: Path, settings: ShardSettings, console: Console) -> None:
    with Progress() as progress:
        lines = write_shards(
            sources, out, settings, lambda done, total: progress.update("shards", done, total, "samples")
        )
    for line in lines:
        say(console, line)
    say(console, f"shards: {out}")
