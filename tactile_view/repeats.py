"""Events that are told again and again, as one each: a graph that is overloaded says so hundreds of times."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import NamedTuple

from tactile_base.stamps import SECOND_NS
from tactile_records.runs.record import Event

CLOSE = 3.0  # s, at most, between two that are told as one
_COMPLAINTS = "diagnostics", "warning"  # the same is told in both


class Repeated(NamedTuple):
    """What was told, at first and at last, and how often in the kind of the first."""

    first_ns: int
    last_ns: int
    kind: str
    text: str
    times: int

    @property
    def words(self) -> str:
        """Kind, how often, and how it was told last."""
        return f"{self.kind}{f' ({self.times} times)' if self.times > 1 else ''}: {self.text}"


def repeats(events: Iterable[Event], close: float = CLOSE) -> list[Repeated]:
    """Events by time; those that differ in nothing but numbers and follow within `close` (s) are one."""
    found = list[Repeated]()
    latest = dict[tuple[str, str], int]()
    for ns, kind, text in events:
        key = _key(kind, text)
        number = latest.get(key)
        if number is None or ns - found[number].last_ns > close * SECOND_NS:
            latest[key] = len(found)
            found.append(Repeated(ns, ns, kind, text, 1))
        else:
            before = found[number]
            times = before.times + (kind == before.kind)
            found[number] = before._replace(last_ns=ns, text=text, times=times)
    return found


def _key(kind: str, text: str) -> tuple[str, str]:
    """What two events share that tell the same; a log names its node with dots, diagnostics with slashes."""
    if kind == "parameter":
        return kind, text
    if kind in _COMPLAINTS:
        kind, text = _COMPLAINTS[0], text.replace("/", ".").lstrip(".")
    return kind, re.sub(r"\b\d[\d.]*", "#", text)  # not those of names, as arm_2
