"""`tactile plugins`: everything that plugs in by name, whose it is, and whether it loads."""

from __future__ import annotations

import argparse
from typing import Any

from rich.console import Console

from tactile_base.console import say
from tactile_base.registry import OURS
from tactile_base.settings import SettingError
from tactile_bringup.commands.changes import add_command
from tactile_bringup.plugin_check import REGISTRIES


def register(subparsers: Any) -> None:
    parser = add_command(subparsers, "plugins", run, __doc__)
    parser.add_argument("--all", action="store_true", help="what this package brings itself, too")


def run(arguments: argparse.Namespace) -> int:
    console, wrong, listed = Console(), 0, 0
    for registry in REGISTRIES:
        for entry in registry.entries():
            if entry.package == OURS and not arguments.all:
                continue
            listed += 1
            what = f"{registry.kind} {entry.name}: {entry.place}, of {entry.package}"
            try:
                problem = f"not used: that of {entry.shadowed_by} has its name" if entry.shadowed_by else ""
                if not problem:
                    registry.load(entry.name)
            except SettingError as error:
                problem = str(error)
            wrong += bool(problem)
            say(console, f"{what}: {problem}" if problem else what, "red" if problem else None)
    if not listed:
        say(console, "no other package brings anything (docs/add_a_task.md, docs/own_arm.md); --all: ours")
    return 1 if wrong else 0
