"""`tactile`: the command line. Each command loads what it needs when it runs, so that help comes at once."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from tactile_bringup.commands import COMMANDS

if TYPE_CHECKING:
    import argparse


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
    from tactile_base.requirements import RequirementMissing, require_packages

    try:
        require_packages()
        require(COMMAND, "a command")
    except (RequirementMissing, LimitError) as error:
        print(f"tactile: {error}", file=sys.stderr)
        return 1 if isinstance(error, RequirementMissing) else 2
    parsed = command_line(words).parse_args(words)
    return int(parsed.run(parsed))


def command_line(words: Sequence[str] | None = None) -> argparse.ArgumentParser:
    """The parser of all commands; what it parses has `run`, a callable of the arguments.

    For given words the others than they ask for are without options, for which nothing has to be loaded.
    """
    import argparse

    from tactile_base.version import version

    parser = argparse.ArgumentParser(
        prog="tactile", description="Servoing by touch: tactile image to pose, shear, belief, twist and arm."
    )
    parser.add_argument("--version", action="version", version=f"tactile_servoing {version()}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    asked = next((COMMANDS[word][0] for word in words or () if word in COMMANDS), "")
    for name, (module, text) in COMMANDS.items():
        if words is None or module == asked:
            if name not in subparsers.choices:  # one module may have several
                importlib.import_module(module).register(subparsers)
        else:
            subparsers.add_parser(name, help=text)
    subparsers.add_parser("version", help="print the version").set_defaults(run=_print_version)
    return parser


def _print_version(arguments: argparse.Namespace) -> int:
    from tactile_base.version import version

    print(version())
    return 0


if __name__ == "__main__":
    sys.exit(main())
