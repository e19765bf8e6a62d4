"""What commands have in common: settings changed by NAME=VALUE, numbers, where jobs run, how they refuse."""

from __future__ import annotations

import argparse
import functools
import os
import traceback
from collections.abc import Callable
from typing import Any

from rich.console import Console

from tactile_base.console import say
from tactile_base.jobs import Workers
from tactile_base.raised import LIBRARY, raised_at, raised_by, raised_in_plugin, told
from tactile_base.settings import SettingError
from tactile_base.yaml_file import name_and_value

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
    parser.add_argument("--jobs", type=positive_int, default=default or cores, metavar="N",
        help=f"{those}processes at a time ({shown})")  # fmt: skip
    parser.add_argument("--scheduler", default="", metavar="ADDRESS",
        help=f"{those}run on the workers of this Dask scheduler instead (without TLS it runs anybody's code)",
    )  # fmt: skip


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


def refusing(command: str, *others: type[Exception], status: int = 1) -> Callable[[Run], Run]:
    """Decorator of what runs a command: wrong input becomes a message and the exit status of that.

    Wrong input is a `ValueError`, an `OSError` or one of `others`. What else a plug-in raises is told in the
    same way, and its traceback below. Where a library of the extra `train` is not installed, the message says
    how to install it, and the status is 2.
    """
    wrong: tuple[type[Exception], ...] = (ValueError, OSError, *others)

    def decorate(run: Run) -> Run:
        @functools.wraps(run)
        def refused(arguments: argparse.Namespace) -> int:
            console = Console(stderr=True)
            try:
                return run(arguments)
            except ModuleNotFoundError as error:
                if error.name not in EXTRA:
                    raise
                say(console, f"tactile {command} needs {error.name}: pip install {' '.join(EXTRA)}")
                return 2
            except Exception as error:
                theirs = raised_in_plugin(error) and not isinstance(error, SettingError | OSError)
                if not theirs and not isinstance(error, wrong):
                    raise
                say(console, f"tactile {command}: {_explained(error)}", "red")
                if origin := next((e for e in (error, error.__cause__) if e and raised_in_plugin(e)), None):
                    say(console, "".join(traceback.format_exception(origin)).rstrip())
                return status

        return refused

    return decorate
