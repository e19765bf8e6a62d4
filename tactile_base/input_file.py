"""Files from outside: regular ones of a sensible size alone, and the text and the JSON in them."""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any

#: Bytes of the longest text that is read at once; settings and descriptions have some thousand.
LARGEST_TEXT = 10_000_000
_LONGEST_WHOLE = 20  # characters of a 64-bit integer
_KINDS = (
    (stat.S_ISDIR, "a folder"), (stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"), (stat.S_ISBLK, "a device"),
)  # fmt: skip


def check_regular(path: Path) -> None:
    """`OSError` unless there is a regular file: of a pipe or a device, reading may never come to an end."""
    mode = path.stat().st_mode
    for is_kind, name in _KINDS:
        if is_kind(mode):
            raise OSError(f"{path}: is {name}, must be a file")


def read_text(path: Path) -> str:
    """The text of a file.

    Raises `OSError` if it cannot be read, is no regular file, or is longer than `LARGEST_TEXT`;
    `UnicodeDecodeError` if it is not UTF-8.
    """
    check_regular(path)
    size = path.stat().st_size
    if size > LARGEST_TEXT:
        raise OSError(f"{path}: has {size} bytes, more than {LARGEST_TEXT}, which none of its kind has")
    return path.read_text(encoding="utf-8")


def parse_json(text: str) -> Any:
    """The value of a text in JSON; `ValueError` where it has none, or is nested too deeply."""
    try:
        return json.loads(
            text, parse_int=lambda whole: (int if len(whole) <= _LONGEST_WHOLE else float)(whole)
        )
    except RecursionError:
        raise ValueError("nested too deeply") from None
