"""`tactile`: the command line. Each command loads what it needs when it runs, so that help comes at once."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse

# Modules that add commands, by name, since some stand above this file: each has `register(subparsers)`, which
# sets `run`, a callable of the arguments.
COMMANDS = (
    "tactile_bringup.commands.launch",
    "tactile_bringup.commands.run",
    "tactile_bringup.commands.stop",
    "tactile_bringup.commands.operate",
    "tactile_bringup.commands.tune",
    "tactile_bringup.commands.move",
    "tactile_bringup.commands.demo",
    "tactile_bringup.commands.simulate",
    "tactile_bringup.commands.experiment",
    "tactile_view.command",
    "tactile_bringup.commands.report",
    "tactile_bringup.commands.compare",
    "tactile_bringup.commands.export",
    "tactile_bringup.commands.replay",
    "tactile_bringup.commands.estimate",
    "tactile_bringup.commands.train",
    "tactile_bringup.commands.evaluate",
    "tactile_bringup.commands.calibrate",
    "tactile_bringup.commands.quantize",
    "tactile_bringup.commands.fit",
    "tactile_bringup.commands.markers",
    "tactile_bringup.commands.camera",
    "tactile_bringup.commands.cell",
    "tactile_bringup.commands.data",
    "tactile_bringup.commands.security",
    "tactile_bringup.commands.arm",
    "tactile_bringup.commands.plugins",
    "tactile_bringup.commands.check",
    "tactile_bringup.commands.new",
    "tactile_bringup.commands.drill",
    "tactile_bringup.commands.doctor",
    "tactile_bringup.commands.completion",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code of the process."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    return _stop(words[1:]) if words[:1] == ["stop"] else _main(words)


def _stop(words: Sequence[str]) -> int:
    """An arm may be about to break something: nothing is checked or loaded first, and nobody waited for."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(os.sched_get_priority_max(os.SCHED_FIFO)))
    from tactile_bringup.commands import stop

    return stop.main(words)


def _main(words: Sequence[str]) -> int:
    from tactile_base.process_limits import COMMAND, LimitError, require
    from tactile_base.requirements import ROS_MODULES, RequirementMissing, require_packages, without_ros
    from tactile_bringup.commands.changes import in_words

    try:
        require_packages()
    except RequirementMissing as error:
        print(f"tactile: {error}", file=sys.stderr)
        return 1
    try:
        require(COMMAND, "a command")
    except LimitError as error:
        print(f"tactile: {error}", file=sys.stderr)
        return 2
    parsed = command_line().parse_args(words)
    try:
        return int(parsed.run(parsed))
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        return 130
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in ROS_MODULES:
            raise
        print(f"tactile {parsed.command}: {without_ros(str(error.name))}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of our output (a pager, head) has gone
        sys.stderr.close()
        return 141
    except OSError as error:  # as of a disk that is full
        print(f"tactile {parsed.command}: {in_words(error)}", file=sys.stderr)
        return 1


def command_line() -> argparse.ArgumentParser:
    """The parser of all commands; what it parses has `run`, a callable of the arguments."""
    import argparse

    from tactile_base.version import version

    parser = argparse.ArgumentParser(
        prog="tactile", description="Servoing by touch: tactile image to pose, shear, belief, twist and arm."
    )
    parser.add_argument("--version", action="version", version=f"tactile_servoing {version()}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for module in COMMANDS:
        importlib.import_module(module).register(subparsers)
    show = subparsers.add_parser("version", help="print the version")
    show.set_defaults(run=_print_version)
    return parser


def _print_version(arguments: argparse.Namespace) -> int:
    from tactile_base.version import version

    print(version())
    return 0


if __name__ == "__main__":
    sys.exit(main())
