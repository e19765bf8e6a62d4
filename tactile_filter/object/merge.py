"""Events of several sources, merged by (stamp, source): handed out once no earlier one is to come.

Each source gives its own events in order; what one has said up to a stamp is complete once it has said
anything of that stamp or a later one. A group of events of one stamp therefore waits until every source has
got as far, but neither for one that is silent nor longer than a deadline. As long as no deadline passes, what
is handed out depends on the events alone and not on how they arrived.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from typing import Any

from tactile_base.settings import unknown_name
from tactile_filter.events import Event

#: The events of one stamp, by source in the order of their names.
EventGroup = Event


class EventMerge:
    """Merges the events of several sources; all times of arrival are of one steady clock, ns.

    Attributes
    ----------
    out_of_order : events refused because their source had given one of that stamp or a later one before
    overtaken : groups handed out after one of a later stamp: their deadline, or their source's silence, had
        let that one pass
    """

    def __init__(self, sources: Sequence[str]) -> None:
        self.sources = tuple(sorted(sources))
        self.out_of_order = 0
        self.overtaken = 0
        self.clear()

    def clear(self) -> None:
        """Forget all that waits, and all stamps."""
        self._groups: list[EventGroup] = []
        self._newest: dict[str, int] = {}  # stamps, by source
        self._heard: dict[str, int] = {}  # arrivals
        self._done_ns: int | None = None

    def __len__(self) -> int:
        return len(self._groups)

    def add(self, source: str, stamp_ns: int, content: Any, now_ns: int) -> bool:
        """Take an event; False (and counted) unless it is later than its source's last one.

        Raises `KeyError` if there is no such source; the message lists those there are.
        """
        if source not in self.sources:
            raise KeyError(unknown_name(source, self.sources))
        if stamp_ns <= self._newest.get(source, stamp_ns - 1):
            self.out_of_order += 1
            return False
        self._newest[source], self._heard[source] = stamp_ns, now_ns
        at = bisect.bisect_left(self._groups, stamp_ns, key=lambda group: group.stamp_ns)
        if at == len(self._groups) or self._groups[at].stamp_ns != stamp_ns:
            self._groups.insert(at, EventGroup(stamp_ns, now_ns))
        self._groups[at].parts[source] = content
        return True

    def take(self, now_ns: int, wait_ns: int, silence_ns: int) -> list[EventGroup]:
        """The groups that are ready, in the order of their stamps.

        Parameters
        ----------
        wait_ns : a group waits no longer than this for other sources
        silence_ns : a source of which nothing has come for longer is not waited for
        """
        speaking = [s for s in self.sources if s in self._heard and now_ns - self._heard[s] <= silence_ns]
        complete_ns = min((self._newest[source] for source in speaking), default=None)
        taken: list[EventGroup] = []
        while self._groups:
            group = self._groups[0]
            complete = complete_ns is None or group.stamp_ns <= complete_ns
            if not complete and now_ns - group.received_ns <= wait_ns:
                break
            taken.append(self._hand_out())
        return taken

    def _hand_out(self) -> EventGroup:
        group = self._groups.pop(0)
        group.parts = dict(sorted(group.parts.items()))
        if self._done_ns is not None and group.stamp_ns <= self._done_ns:
            self.overtaken += 1
        else:
            self._done_ns = group.stamp_ns
        return group
