"""Reads JSON files of published data sets, some of which are malformed, and says what was repaired."""

from __future__ import annotations

import json
from typing import Any

from tactile_base.input_file import parse_json

_MOST_REPAIRS = 20  # of a file with more, nobody knows what it was to say
_CLOSING = {"}": "{", "]": "["}


class JsonError(ValueError):
    """JSON that is malformed beyond its brackets."""


def loads(text: str, name: str) -> tuple[Any, list[str]]:
    """Parse JSON, dropping brackets that close nothing and adding those that are missing at the end.

    Gives the value and one sentence for each repair; raises `JsonError` if the text does not parse even then.

    Parameters
    ----------
    text : contents of the file; `Infinity` and `NaN` are accepted, as Python writes them
    name : what to call the file in messages
    """
    try:
        return parse_json(text), []
    except json.JSONDecodeError as error:
        repaired, repairs = _balanced(text)
        try:
            value = parse_json(repaired)
        except ValueError:
            where = f"line {error.lineno}, column {error.colno}"
            raise JsonError(f"{name}: malformed JSON at {where} ({error.msg}); not repairable") from error
        return value, [f"{name}: malformed JSON; {repair}" for repair in repairs]
    except ValueError as error:
        raise JsonError(f"{name}: {error}") from error


def _balanced(text: str) -> tuple[str, list[str]]:
    """The text with every bracket matched, and what was changed."""
    kept: list[str] = []
    opened: list[str] = []
    repairs: list[str] = []
    in_string = escaped = False
    for position, character in enumerate(text):
        if in_string:
            in_string = escaped or character != '"'
            escaped = character == "\\" and not escaped
        elif character == '"':
            in_string = True
        elif character in "[{":
            opened.append(character)
        elif character in _CLOSING:
            if not opened or opened[-1] != _CLOSING[character]:
                before = text[:position]
                where = f"line {before.count(chr(10)) + 1}, column {position - before.rfind(chr(10))}"
                if len(repairs) == _MOST_REPAIRS:
                    return text, []
                repairs.append(f"dropped a surplus '{character}' at {where}")
                continue
            opened.pop()
        kept.append(character)
    missing = "".join("}" if bracket == "{" else "]" for bracket in reversed(opened))
    if missing:
        repairs.append(f"added the missing '{missing}' at the end")
    return "".join(kept) + missing, repairs
