"""What commands have in common: how they are added and refuse, `--set NAME=VALUE`, numbers, where jobs run.

Command lines are argparse's. tyro (1.0) was tried on `simulate` and `stop`: it takes 28 lines for the options
of `simulate`, which are 15 here, and 90 ms of processor to load, in place of 10; and nothing is gained of the
declared settings, since which of them there are is known only once `--set` has met the roles of a task file.
"""

from __future__ import annotations

import argparse
import inspect
import os
import sys
import traceback
from collections.abc import Callable
from typing import Any

from rich.console import Console

from tactile_base.console import say
from tactile_base.jobs import Workers
from tactile_base.raised import LIBRARY, raised_at, raised_by, raised_in_plugin, told
from tactile_base.requirements import ROS_MODULES, without_ros
from tactile_base.settings import SettingError
from tactile_base.yaml_file import name_and_value
from tactile_bringup.commands import COMMANDS

Run = Callable[[argparse.Namespace], int]
EXTRA = ("torch", "onnx")  # libraries of the extra `train`


def add_set_option(parser: Any, doc: str, metavar: str = "NAME=VALUE") -> None:
    """Add `--set`, which may be given again and again; its texts become `changes`."""
    parser.add_argument("--set", action="append", default=[], metavar=metavar, dest="changes", help=doc)


def changed_settings(changes: list[str], example: str) -> dict[str, Any]:
    """Names and values of the texts of `--set`; `SettingError` shows the example."""
    return dict(name_and_value(change, example) for change in changes)


def positive_int(text: str) -> int:
    """Type of an option that counts something: a whole number from 1 on."""
    return _whole(text, 1)


def natural_int(text: str) -> int:
    """Type of an option such as a seed: a whole number from 0 on."""
    return _whole(text, 0)


def _whole(text: str, least: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if value < least:
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number from {least} on")
    return value


def add_job_options(parser: Any, default: int | None = None, those: str = "") -> None:
    """Add `--jobs` and `--scheduler`, of the commands whose work is many jobs; `workers_of` reads them.

    Parameters
    ----------
    default : of processes; None: as many as cores
    those : which runs they are of, where the command has others
    """
    cores = len(os.sched_getaffinity(0))
    shown = f"as many as cores: {cores}" if default is None else default
    add, text = parser.add_argument, f"{those}processes at a time ({shown})"
    add("--jobs", type=positive_int, default=default or cores, metavar="N", help=text)
    text = f"{those}run on the workers of this Dask scheduler instead (without TLS it runs anybody's code)"
    add("--scheduler", default="", metavar="ADDRESS", help=text)


def workers_of(arguments: argparse.Namespace) -> Workers:
    """Where the jobs of a command run."""
    return Workers(arguments.jobs, arguments.scheduler)


def in_words(error: Exception) -> str:
    """What an error says; of one of the system the file and the reason, without its number."""
    if isinstance(error, OSError) and error.strerror is not None:
        return error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"
    return str(error)


def _explained(error: Exception) -> str:
    """An error in words, with its place unless it was written for the user: whose plug-in, or which line."""
    if isinstance(error, SettingError | OSError):
        return in_words(error)
    if raised_in_plugin(error):
        return told(error)
    return f"{in_words(error)} ({raised_at(error)})" if raised_by(error) == LIBRARY else in_words(error)


def add_group(commands: Any, name: str, about: str | None) -> Any:
    """Add a command that has commands of its own; returns what takes these."""
    parser = commands.add_parser(name, help=COMMANDS[name][1], description=about)
    return parser.add_subparsers(dest="what", metavar="COMMAND", required=True)


def add_command(
    commands: Any,
    name: str,
    run: Run,
    about: str | None = None,
    *,
    help: str = "",
    epilog: str | None = None,
    status: int = 2,
    wrong: tuple[type[Exception], ...] = (),
) -> argparse.ArgumentParser:
    """Add a command to argparse subparsers; returns its parser, for options.

    Parameters
    ----------
    about : what its own help says first (default: the docstring of `run`)
    help : what the list of commands says of it (default: by `COMMANDS`)
    status : exit code of wrong input (`refusing`)
    wrong : errors besides `ValueError` and `OSError` that mean wrong input
    """
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=help or COMMANDS[name][1], description=about or inspect.getdoc(run), epilog=epilog
    )
    parser.set_defaults(run=refusing(run, parser.prog, status, wrong))
    return parser


def refusing(run: Run, command: str, status: int = 2, wrong: tuple[type[Exception], ...] = ()) -> Run:
    """What runs a command, and says in a sentence what is wrong with its input, or with this machine.

    What else a plug-in raises is told in the same way, and its traceback below.
    """

    def refused(arguments: argparse.Namespace) -> int:
        console = Console(stderr=True)
        try:
            return run(arguments)
        except KeyboardInterrupt:
            say(console, "\ninterrupted")
            return 130
        except BrokenPipeError:  # the reader of our output (a pager, head) has gone
            sys.stderr.close()
            return 141
        except ModuleNotFoundError as error:
            if error.name in EXTRA:
                say(console, f"{command} needs {error.name}: pip install {' '.join(EXTRA)}")
            elif (error.name or "").split(".")[0] in ROS_MODULES:
                say(console, f"{command}: {without_ros(str(error.name))}")
            else:
                raise
            return 2
        except Exception as error:
            theirs = raised_in_plugin(error) and not isinstance(error, SettingError | OSError)
            if not theirs and not isinstance(error, (ValueError, OSError, *wrong)):
                raise
            say(console, f"{command}: {_explained(error)}", "red")
            if origin := next((e for e in (error, error.__cause__) if e and raised_in_plugin(e)), None):
                say(console, "".join(traceback.format_exception(origin)).rstrip())
            return status

    return refused
