"""`tactile check PLUGIN`: tries a task, arm, camera, shape or motion on what its contract says."""

from __future__ import annotations

import argparse
from typing import Any

from rich.console import Console

from tactile_base.console import say
from tactile_base.yaml_file import values_of
from tactile_bringup.commands.changes import add_command, add_set_option, changed_settings
from tactile_bringup.plugin_check import check_plugin, kind_of


def register(subparsers: Any) -> None:
    parser = add_command(subparsers, "check", run, __doc__, wrong=(RuntimeError,))
    add = parser.add_argument
    add("plugin", metavar="PLUGIN", help="its name (`tactile plugins`), or module:attribute with --kind")
    add("--kind", default="", metavar="KIND", help="task, shape, 'body motion', 'arm driver', ...")
    add("--scene", default="", metavar="FILE", help="of a driver: the scene whose arm or camera it opens")
    add("--arm", default="", metavar="NAME", help="its arm (default: the first)")
    add("--goal", default="", metavar="YAML", help="of a task: what its goal says, as '{length: 0.05}'")
    add("--move", action="store_true", help="an arm may go a millimetre along its z and back, at 5 mm/s")
    add_set_option(parser, "a setting of a shape, motion or task")


def run(arguments: argparse.Namespace) -> int:
    console = Console()
    kind = arguments.kind or kind_of(arguments.plugin)
    values = changed_settings(arguments.changes, "radius=0.02")
    problems = check_plugin(
        kind,
        arguments.plugin,
        values,
        arguments.scene,
        arguments.arm,
        moves=arguments.move,
        goal=values_of(arguments.goal, "--goal"),
    )
    for problem in problems:
        say(console, f"{kind} {arguments.plugin}: {problem}", "red")
    if not problems:
        say(console, f"{kind} {arguments.plugin}: keeps its contract, as far as it was tried")
    return 1 if problems else 0
