"""Events in the order of (stamp, source, sequence), never of arrival: messages of one stamp, joined."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

JUMP_NS = 100_000_000
"""A stamp that is this much older than the newest of its source means that the clock was set back."""

FUTURE_NS = 100_000_000
"""A stamp that lies further ahead of the clock than this is wrong, and is refused."""


@dataclass
class Event:
    """All messages of one stamp, by source; `received_ns` (steady clock) is the first one's arrival."""

    stamp_ns: int
    received_ns: int
    parts: dict[str, Any] = field(default_factory=dict)


class EventJoin:
    """Joins the messages of one stamp from several sources; hands the events out in the order of stamps.

    Every source delivers its own messages in order. So an event that misses a source is lost as soon as that
    source has delivered a later stamp; until then it may still come and the caller decides how long to wait.
    What is handed out therefore depends on the messages and not on the order in which the sources' messages
    arrived, as long as no deadline passes.

    Parameters
    ----------
    complete : callable, optional
        Whether these parts will do; by default all sources are needed.

    Attributes
    ----------
    late : int
        Messages refused because their stamp was not later than what had been handed out or dropped.
    dropped : int
        Events dropped because a source had skipped their stamp, or by `drop_oldest`.
    done_ns : int
        Stamp of the last event that was handed out or dropped.
    """

    def __init__(
        self, sources: Sequence[str], complete: Callable[[Mapping[str, Any]], bool] | None = None
    ) -> None:
        self.sources = tuple(sources)
        self._complete = complete
        self.late = 0
        self.dropped = 0
        self.clear()

    def clear(self) -> None:
        """Forget all pending events and the last stamp, after a backward time jump for instance."""
        self._events: list[Event] = []
        self._newest = dict.fromkeys(self.sources, -1)
        self.done_ns = -1

    def __len__(self) -> int:
        return len(self._events)

    def add(self, source: str, stamp_ns: int, message: Any, received_ns: int) -> bool:
        """Take a message; False (and counted) if its stamp has been passed already."""
        if stamp_ns <= self.done_ns or stamp_ns <= self._newest[source]:
            self.late += 1
            return False
        self._newest[source] = stamp_ns
        index = bisect.bisect_left(self._events, stamp_ns, key=lambda event: event.stamp_ns)
        if index == len(self._events) or self._events[index].stamp_ns != stamp_ns:
            self._events.insert(index, Event(stamp_ns, received_ns))
        self._events[index].parts[source] = message
        return True

    def oldest(self) -> Event | None:
        """The oldest pending event, complete or not."""
        return self._events[0] if self._events else None

    def missing(self, event: Event) -> list[str]:
        """The sources that the event still waits for."""
        if self._complete is not None and self._complete(event.parts):
            return []
        return [source for source in self.sources if source not in event.parts]

    def ready(self) -> Event | None:
        """The oldest event if it is complete; older ones that cannot become complete any more are dropped."""
        while self._events:
            event = self._events[0]
            missing = self.missing(event)
            if not missing:
                return event
            if all(self._newest[source] < event.stamp_ns for source in missing):
                return None
            self.drop_oldest()
        return None

    def pop(self) -> Event:
        """Take the oldest event off; from now on its stamp is past."""
        event = self._events.pop(0)
        self.done_ns = event.stamp_ns
        return event

    def drop_oldest(self) -> Event:
        """Give the oldest event up and count it."""
        self.dropped += 1
        return self.pop()


def measurement_join() -> EventJoin:
    """Joins `presence` and `estimate`, each as (content, received); without contact presence will do."""
    return EventJoin(
        ("presence", "estimate"), complete=lambda parts: "estimate" in parts or says_no_contact(parts)
    )


def says_no_contact(parts: Mapping[str, Any]) -> bool:
    """Whether a contact presence among an event's parts is one without contact, whatever an estimate says."""
    return "presence" in parts and not parts["presence"][0]
