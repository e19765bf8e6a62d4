"""`tactile plugins`: everything that plugs in by name, whose it is, and whether it loads."""

from __future__ import annotations

import argparse
from typing import Any

from tactile_base.registry import OURS, Registry


def register(subparsers: Any) -> None:
    """Add `plugins`."""
    parser = subparsers.add_parser(
        "plugins", help="what plugs in by name, and whether it loads", description=__doc__
    )
    parser.add_argument("--all", action="store_true", help="what this package brings itself, too")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the command; 1 if an entry does not load, or is never used."""
    from rich.console import Console

    from tactile_base.console import say
    from tactile_base.settings import SettingError

    console, wrong, listed = Console(), 0, 0
    for registry in registries():
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


def registries() -> list[Registry[Any]]:
    """All of them."""
    from tactile_control.tasks import TASKS
    from tactile_doubles.rehearsal import DOUBLES
    from tactile_perception.estimating.contact_model import CONTACT_MODELS
    from tactile_records.runs.report import REPORTS
    from tactile_scene.arm import ARMS
    from tactile_scene.camera import CAMERAS
    from tactile_scene.motions import MOTIONS
    from tactile_scene.shapes import SHAPES

    return [TASKS, REPORTS, ARMS, DOUBLES, CAMERAS, SHAPES, MOTIONS, CONTACT_MODELS]
