"""Markdown of values, tables and docstrings."""

from __future__ import annotations

import inspect
import re
from typing import Any

from tactile_base.registry import OURS, Registry


def cell(text: object) -> str:
    """Text for a cell of a table."""
    parts = re.split(r"(`[^`]*`)", " ".join(str(text).split()))
    return "".join(p if p.startswith("`") else p.replace("<", "&lt;") for p in parts).replace("|", "\\|")


def table(head: str, rows: list[tuple[object, ...]]) -> str:
    """A table with the columns of `head`, which are separated by ` | `."""
    lines = [f"| {head} |", "| " + " | ".join("---" for _ in head.split(" | ")) + " |"]
    return "\n".join([*lines, *("| " + " | ".join(map(cell, row)) + " |" for row in rows)]) + "\n"


def code(value: object) -> str:
    """A value as YAML has it; nothing for an empty one."""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple):
        return f"`[{', '.join(code(item).strip('`') for item in value)}]`"
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return f"`{text}`" if text else ""


def first_sentences(item: Any) -> str:
    """The docstring up to its first section, as a paragraph."""
    return " ".join(re.split(r"\n\s*\n\s*\w+\n\s*-{3,}", inspect.getdoc(item) or "")[0].split())


def ours(registry: Registry[Any]) -> dict[str, Any]:
    """What this package brings of a registry, by name."""
    return {entry.name: registry.load(entry.name) for entry in registry.entries() if entry.package == OURS}
