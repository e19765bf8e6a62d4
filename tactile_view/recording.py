"""Recording: a bag as messages in time, which is played, paused and sought, also while it is written.

What is shown is read when its time comes, so that the bag may be larger than the memory. What the whole
recording tells beside its numbers is gathered little by little, meanwhile.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import groupby, islice
from pathlib import Path
from typing import Any

from tactile_base import topics
from tactile_base.stamps import SECOND_NS
from tactile_records.bags.contents import BagError, Recorded
from tactile_records.bags.seeking import SeekableBag
from tactile_records.runs.events import tells
from tactile_records.runs.from_bag import STREAMS
from tactile_records.runs.record import Event
from tactile_view.cell_state import WINDOW, CellState

MOST_AT_ONCE = 20_000  # messages in one step; further ones come with the next
MOST_EVENTS = 20_000  # of a recording, the latest
LOOK, STILL = 0.5, 5.0  # s, between looks for what is new; without anything new it is written no more
MOMENT, BETWEEN = SECOND_NS // 2, SECOND_NS // 60
LASTING = {topics.TF_STATIC.name}
_OFTEN = tuple(f"/{name}" for name, _ in STREAMS.values())
_TOLD_BY_ARMS = topics.ARM_STATUS.name, topics.CONTROLLER_STATUS.name


class Recording:
    """See the module's text; `poll` gives the messages up to now to the state.

    Attributes
    ----------
    playing, speed : whether time goes on, and how many times as fast as it went
    now_ns : the time that is shown
    events : phases, refusals, warnings and changes of the recording, as far as it was `looked_through`
    looked_through : part of it, 0 to 1
    """

    def __init__(self, folder: Path, state: CellState) -> None:
        self._bag, self._state = SeekableBag(folder), state
        self.bag = self._bag.contents
        if not any(name.endswith(_TOLD_BY_ARMS) for name in self.bag.types):
            listed = ", ".join(sorted(self.bag.types)) or "none"
            raise BagError(f"{folder}: holds no arm's status, so there is nothing to show; topics: {listed}")
        self.start_ns, self.playing, self.speed = self._bag.start_ns, True, 1.0
        self.now_ns, self._shown_at = self.start_ns, time.monotonic()
        self._looked_at = self._grew_at = time.monotonic()
        self._next: Recorded | None = None
        self._coming = self._after(self.start_ns - 1)
        self._lasting: list[Recorded] = []
        self._told = CellState(self.types, MOST_EVENTS)
        self._looked_ns, self.looked_through = self.start_ns, 0.0
        self._looking = self._look_through()

    def types(self, type_name: str) -> Any:
        """A type as the bag defines it, else as it is installed."""
        return self.bag.typestore(type_name)

    @property
    def events(self) -> list[Event]:
        """See the attributes."""
        return list(self._told.events)

    @property
    def seconds(self) -> float:
        """The time that is shown, from the start, s."""
        return (self.now_ns - self.start_ns) / SECOND_NS

    @property
    def end_ns(self) -> int:
        """Time of the last message, up to now."""
        return self._bag.end_ns

    @property
    def growing(self) -> bool:
        """Whether it is still written, as far as that can be seen."""
        return self._bag.open_ended and time.monotonic() - self._grew_at < STILL

    @property
    def duration(self) -> float:
        """How long the recording is, s."""
        return (self.end_ns - self.start_ns) / SECOND_NS

    def poll(self, timeout_s: float, looked_at: bool = True) -> None:
        """Go on by the time that has passed, if somebody looks, and gather events for so long."""
        end = time.monotonic() + timeout_s
        self._look_again()
        while time.monotonic() < end and self.look_on():
            pass
        time.sleep(max(0.0, end - time.monotonic()))
        passed, self._shown_at = time.monotonic() - self._shown_at, time.monotonic()
        if self.playing and looked_at:
            self.now_ns = min(self.end_ns, self.now_ns + round(passed * self.speed * SECOND_NS))
            self.playing = self.now_ns < self.end_ns or self.growing
        self._give(self.now_ns)

    def seek(self, seconds: float) -> None:
        """Show another time; what came in the last seconds before it is given again, and what lasts."""
        self.now_ns = min(self.end_ns, max(self.start_ns, self.start_ns + round(seconds * SECOND_NS)))
        since = self.now_ns - round(WINDOW * SECOND_NS)
        self._state.clear()
        for message in self._lasting:
            if message.received_ns < since:
                self._state.take(*message[:4])
        for message in self._thinned(self._bag.between(since, self.now_ns + 1)):
            self._state.take(*message[:4])
        self._coming, self._next = self._after(self.now_ns), None
        self._shown_at = time.monotonic()

    def step(self, frames: int) -> None:
        """Go by so many exposures, forwards or backwards, and stay there."""
        self.playing, now, away = False, self.now_ns, SECOND_NS
        names = {name for name in self.bag.types if name.endswith(topics.STATE.name)} or None
        if frames > 0:
            later = (message.received_ns for message in self._bag.between(now + 1, self.end_ns + 1, names))
            stamps = list(islice((stamp for stamp, _ in groupby(later)), frames))
            self.seek(((stamps or [now])[-1] - self.start_ns) / SECOND_NS)
            return
        stamps = self._stamps(now - away, now, names)
        while len(stamps) <= -frames and now - away > self.start_ns:
            away *= 10
            stamps = self._stamps(now - away, now, names)
        self.seek(((stamps or [now])[max(-len(stamps), frames - 1)] - self.start_ns) / SECOND_NS)

    def look_on(self) -> bool:
        """Gather a few more events; False once all are."""
        return next(self._looking)

    def _look_again(self) -> None:
        """Take in what was written since, now and then."""
        now = time.monotonic()
        if now - self._looked_at > LOOK:
            self._looked_at = now
            if self._bag.look_again():
                self._grew_at = now

    def _stamps(self, start_ns: int, last_ns: int, names: set[str] | None) -> list[int]:
        return sorted({message.received_ns for message in self._bag.between(start_ns, last_ns + 1, names)})

    def _after(self, ns: int) -> Iterator[Recorded | None]:
        """What comes after a time; None where nothing is, or not yet."""
        while True:
            end = self.end_ns
            yield from self._bag.between(ns + 1, end + 1)
            ns = max(ns, end)
            yield None

    def _give(self, until_ns: int) -> None:
        for _ in range(MOST_AT_ONCE):
            if self._next is None:
                self._next = next(self._coming)
            if self._next is None or self._next.received_ns > until_ns:
                return
            self._state.take(*self._next[:4])
            self._next = None

    def _thinned(self, messages: Iterator[Recorded]) -> Iterator[Recorded]:
        """Of what is said more often than a chart shows, what is shown; of the last moment everything."""
        taken = dict[str, int]()
        for message in messages:
            if message.topic.endswith(_OFTEN) and self.now_ns - message.received_ns > MOMENT:
                if message.received_ns - taken.get(message.topic, 0) < BETWEEN:
                    continue
                taken[message.topic] = message.received_ns
            yield message

    def _look_through(self) -> Iterator[bool]:
        """What the whole recording tells beside its numbers, and what lasts; False where nothing is left."""
        names = {name for name in self.bag.types if name in LASTING or tells(name)}
        while True:
            if self._looked_ns <= (end := self.end_ns):
                yield from self._look_from(self._looked_ns, end, names)
            self._looked_ns, self.looked_through = end + 1, 1.0
            yield False

    def _look_from(self, start_ns: int, end_ns: int, names: set[str]) -> Iterator[bool]:
        for count, message in enumerate(self._bag.between(start_ns, end_ns + 1, names)):
            if message.topic in LASTING:
                self._lasting.append(message)
                if message.received_ns < self.now_ns:  # what is shown was sought before this was found
                    self._state.take(*message[:4])
            else:
                self._told.take(*message[:4])
            if count % 20 == 0:
                self.looked_through = (message.received_ns - self.start_ns) / max(1, end_ns - self.start_ns)
                yield True
