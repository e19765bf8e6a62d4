"""Print a script by which a shell completes commands, options, names of tasks and scenes, and files.

It needs shtab. In a checkout `. scripts/env.sh` has done it; elsewhere: eval "$(tactile completion bash)"
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tactile_base.config_paths import config_names
from tactile_bringup.commands.changes import add_command

SHELLS = ("bash", "zsh")
#: Folder of the configuration that the value of an argument is named in, by the argument.
_NAMED = {"task": "tasks", "scene": "scenes", "controller": "controllers", "filter": "filters"}
_BASH = """{function}() {{
  compgen -W '{names}' -- "$1"
  compgen -d -- "$1"
  compgen -f -X '!*.yaml' -- "$1"
}}
"""
_ZSH = """{function}() {{
  _alternative '{kind}:{kind}:({names})' 'files:file:_files -g "*.yaml"'
}}
"""


def register(subparsers: Any) -> None:
    add_command(subparsers, "completion", run, __doc__).add_argument("shell", choices=SHELLS)


def run(arguments: argparse.Namespace) -> int:
    try:
        import shtab
    except ModuleNotFoundError as error:
        raise ValueError(f"needs shtab: {sys.executable} -m pip install shtab") from error
    from tactile_bringup.cli import command_line

    parser = command_line()
    for command in parsers(parser):
        for action in command._actions:
            _complete(action, shtab.FILE)
    template = {"bash": _BASH, "zsh": _ZSH}[arguments.shell]
    functions = (
        template.format(function=_function(folder), kind=folder, names=" ".join(config_names(folder)))
        for folder in _NAMED.values()
    )
    print(shtab.complete(parser, arguments.shell, preamble="".join(functions)))
    return 0


def _complete(action: argparse.Action, files: Any) -> None:
    if action.dest in _NAMED:
        action.complete = dict.fromkeys(SHELLS, _function(_NAMED[action.dest]))  # type: ignore[attr-defined]
    elif action.type is Path:
        action.complete = files  # type: ignore[attr-defined]


def _function(folder: str) -> str:
    return f"_tactile_{folder}"


def parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """A parser and those of its commands, each once."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in dict.fromkeys(action.choices.values()):
                yield from parsers(command)
