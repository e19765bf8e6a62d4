"""`tactile new KIND NAME`: writes a package with a plug-in of one's own, which passes its own tests."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tactile_bringup.commands.changes import add_command
from tactile_bringup.new_package import ENTRY_POINTS, write_package


def register(subparsers: Any) -> None:
    add = add_command(subparsers, "new", run, __doc__).add_argument
    add("kind", choices=list(ENTRY_POINTS), metavar="KIND", help=", ".join(ENTRY_POINTS))
    add("name", metavar="NAME", help="of the plug-in and its package, as my_arm")
    add("--folder", type=Path, default=Path(), help="where (default: here)")


def run(arguments: argparse.Namespace) -> int:
    written = write_package(arguments.kind, arguments.name, arguments.folder)
    print(*written, sep="\n")
    print(f"Install it by `pip install -e {written[0].parent}`, try it by `pytest {written[0].parent}`.")
    return 0
