"""The last inputs of a filter in their order, each with what the filter remembered before it.

An input that comes late is put in its place; the filter goes back to what it remembered there and takes it
and everything after it again. Since a step is a function of memory and input, the result is, to the bit,
that of inputs that came in order.
"""

from __future__ import annotations

import bisect
from dataclasses import dataclass
from typing import Any, NamedTuple

from tactile_geometry.gaussian import PoseGaussian

# However long the history may be in time, it never holds more inputs than these (about 3 MB).
CAPACITY = 2048


class Key(NamedTuple):
    """Inputs are ordered by stamp, then source, then sequence number: never by arrival."""

    stamp_ns: int
    source: str
    sequence: int


@dataclass
class Entry:
    """One input and what the filter remembered before it; `tuning` are the settings it came under."""

    key: Key
    measurement: PoseGaussian
    T_base_sensor: Any
    tuning: Any
    before: Any = None


class History:
    """Entries by key, not older than the newest by more than `span_ns`, and at most `CAPACITY` of them.

    Nothing of the stamp `floor_ns` or an earlier one may be put in any more; it is None before anything was
    forgotten.
    """

    def __init__(self, span_ns: int) -> None:
        self.span_ns = span_ns
        self.floor_ns: int | None = None
        self._entries: list[Entry] = []

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest entry; None without any."""
        return self._entries[-1].key.stamp_ns if self._entries else None

    def takes(self, stamp_ns: int) -> bool:
        """Whether an input of this stamp still has a place."""
        if self.floor_ns is not None and stamp_ns <= self.floor_ns:
            return False
        return not self._entries or self._entries[-1].key.stamp_ns - stamp_ns <= self.span_ns

    def insert(self, entry: Entry) -> list[Entry]:
        """Put an entry in its place, with what was remembered there; returns it and all that follow it.

        An entry that is the last keeps its own `before`.
        """
        at = bisect.bisect_right(self._entries, entry.key, key=lambda each: each.key)
        if at < len(self._entries):
            entry.before = self._entries[at].before
        self._entries.insert(at, entry)
        following = self._entries[at:]
        self._trim()
        return following

    def clear(self, floor_ns: int | None = None) -> None:
        """Drop all entries; nothing of `floor_ns` or earlier will be taken."""
        self._entries.clear()
        self.floor_ns = floor_ns

    def _trim(self) -> None:
        """Forget what is too old or too much."""
        oldest_ns = self._entries[-1].key.stamp_ns - self.span_ns
        kept = bisect.bisect_left(self._entries, oldest_ns, key=lambda entry: entry.key.stamp_ns)
        kept = max(kept, len(self._entries) - CAPACITY)
        if kept > 0:
            self.floor_ns = self._entries[kept - 1].key.stamp_ns
            del self._entries[:kept]
