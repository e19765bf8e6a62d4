"""What commands print: lines that stay as they are, and tables of numbers."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable, Iterable
from typing import Any, TextIO

from rich.console import Console
from rich.table import Table
from rich.text import Text


def say(console: Console, text: str, style: str | None = None) -> None:
    """Print a line without markup, highlights or breaks."""
    console.print(Text(text, style or ""), soft_wrap=True)


def wide_console(width: int = 160) -> Console:
    """On standard output; into a file or pipe, tables are not broken to the 80 columns of no terminal."""
    console = Console()
    return console if console.is_terminal else Console(width=width)


def lasting_console() -> Console:
    """On standard output; falls silent where its terminal is closed: who moves an arm has to go on."""
    return Console(file=_Lasting(sys.stdout))  # type: ignore[arg-type]


class _Lasting:
    """A stream whose terminal may vanish; any other error of a write is one."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        self._lasting(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        self._lasting(self._stream.flush)

    def _lasting(self, act: Callable[[], Any]) -> None:
        try:
            act()
        except OSError as error:
            if error.errno != errno.EIO:  # what a terminal says that was closed
                raise
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())  # takes what the stream has kept, too
            os.close(nowhere)


def number_table(title: str, columns: Iterable[str], **options: Any) -> Table:
    """A table for names in the first column and numbers, aligned to the right, in the others."""
    table = Table(title=title, **options)
    for index, name in enumerate(columns):
        table.add_column(name, justify="right" if index else "left")
    return table
