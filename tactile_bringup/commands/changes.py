"""What commands have in common: settings changed by NAME=VALUE, and how they refuse."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

EXTRA = ("torch", "onnx")  # libraries of the extra `train`


def add_set_option(parser: Any, doc: str, metavar: str = "NAME=VALUE") -> None:
    """Add `--set`, which may be given again and again; its texts become `changes`."""
    parser.add_argument("--set", action="append", default=[], metavar=metavar, dest="changes", help=doc)


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


def refuse(console: Console, command: str, error: Exception) -> int:
    """Print what was wrong with a command; returns the exit status of that."""
    text = str(error)
    if isinstance(error, OSError) and error.filename is not None:  # the system's: without its number
        text = f"{error.filename}: {error.strerror}"
    console.print(f"tactile {command}: {text}", markup=False, style="red", soft_wrap=True)
    return 1


def needs_extra(console: Console, command: str, error: ModuleNotFoundError) -> int:
    """Print how to install what a command of the extra `train` lacks; returns the exit status of that."""
    if error.name not in EXTRA:
        raise error
    text = f"tactile {command} needs {error.name}: pip install 'tactile_servoing[train]'"
    console.print(text, markup=False, soft_wrap=True)
    return 2
