"""What commands print: lines that stay as they are, and tables of numbers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text


def say(console: Console, text: str, style: str | None = None) -> None:
    """Print a line without markup, highlights or breaks."""
    console.print(Text(text, style or ""), soft_wrap=True)


def number_table(title: str, columns: Iterable[str], **options: Any) -> Table:
    """A table for names in the first column and numbers, aligned to the right, in the others."""
    table = Table(title=title, **options)
    for index, name in enumerate(columns):
        table.add_column(name, justify="right" if index else "left")
    return table
