"""`tactile new KIND NAME`: writes a package with a plug-in of one's own, which passes its own tests."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tactile_bringup.commands.changes import refusing
from tactile_bringup.new_package import ENTRY_POINTS


def register(subparsers: Any) -> None:
    """Add `new`."""
    doc = "write a package with a plug-in of your own"
    parser = subparsers.add_parser("new", help=doc, description=__doc__)
    parser.add_argument("kind", choices=list(ENTRY_POINTS), metavar="KIND", help=", ".join(ENTRY_POINTS))
    parser.add_argument("name", metavar="NAME", help="of the plug-in and its package, as my_arm")
    parser.add_argument("--folder", type=Path, default=Path(), help="where (default: here)")
    parser.set_defaults(run=run)


@refusing("new", status=2)
def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from tactile_bringup.new_package import write_package

    written = write_package(arguments.kind, arguments.name, arguments.folder)
    print(*written, sep="\n")
    print(f"Install it by `pip install -e {written[0].parent}`, try it by `pytest {written[0].parent}`.")
    return 0
