"""Recording: a bag as messages in time, which is played, paused and sought."""

from __future__ import annotations

import bisect
import time
from pathlib import Path
from typing import Any

from tactile_base.stamps import SECOND_NS
from tactile_base.topics import ARM_STATUS, CONTROLLER_STATUS, TF_STATIC
from tactile_records.bags.reader import Bag, BagError, read_bag
from tactile_view.cell_state import WINDOW, CellState, Event

SLOWEST, FASTEST = 0.05, 10.0  # times real time
MOST_AT_ONCE = 20_000  # messages in one step; further ones come with the next


class Recording:
    """See the module's text; `poll` gives the messages up to now to the state.

    Attributes
    ----------
    playing, speed : whether time goes on, and how many times as fast as it went
    now_ns : the time that is shown
    events : all phases, refusals, warnings and changes of the recording
    """

    def __init__(self, folder: Path, state: CellState) -> None:
        self.bag: Bag = read_bag(folder)
        self.messages = sorted(self.bag.messages, key=lambda message: message.received_ns)
        if not any(name.endswith((ARM_STATUS.name, CONTROLLER_STATUS.name)) for name in self.bag.topics):
            listed = ", ".join(sorted(self.bag.topics)) or "none"
            raise BagError(f"{folder}: holds no arm's status, so there is nothing to show; topics: {listed}")
        self._stamps = [message.received_ns for message in self.messages]
        self._state = state
        self.start_ns, self.end_ns = self._stamps[0], self._stamps[-1]
        self.playing, self.speed = True, 1.0
        self.now_ns, self._next, self._shown_at = self.start_ns, 0, time.monotonic()
        self.events = self._all_events()

    def types(self, type_name: str) -> Any:
        """A type as the bag defines it, else as it is installed."""
        return self.bag.typestore(type_name)

    @property
    def seconds(self) -> float:
        """The time that is shown, from the start, s."""
        return (self.now_ns - self.start_ns) / SECOND_NS

    @property
    def duration(self) -> float:
        """How long the recording is, s."""
        return (self.end_ns - self.start_ns) / SECOND_NS

    def poll(self, timeout_s: float) -> None:
        """Go on by the time that has passed, and wait for the rest of so long."""
        time.sleep(timeout_s)
        passed, self._shown_at = time.monotonic() - self._shown_at, time.monotonic()
        if self.playing:
            self.now_ns = min(self.end_ns, self.now_ns + round(passed * self.speed * SECOND_NS))
            self.playing = self.now_ns < self.end_ns
        self._give(self.now_ns)

    def seek(self, seconds: float) -> None:
        """Show another time; what came in the last seconds before it is given again, and what lasts."""
        self.now_ns = min(self.end_ns, max(self.start_ns, self.start_ns + round(seconds * SECOND_NS)))
        since = bisect.bisect_left(self._stamps, self.now_ns - round(WINDOW * SECOND_NS))
        self._state.clear()
        for message in self.messages[:since]:
            if message.topic == TF_STATIC.name:  # what lasts: where arms stand
                self._state.take(message.topic, message.type, message.data, message.received_ns)
        self._next = since
        self._give(self.now_ns)

    def step(self, frames: int) -> None:
        """Go by so many exposures, forwards or backwards, and stay there."""
        self.playing = False
        stamps = sorted({m.received_ns for m in self.messages if m.topic.endswith("contact/state")})
        stamps = stamps or self._stamps
        place = bisect.bisect_right(stamps, self.now_ns) - 1 + frames
        self.seek((stamps[min(max(place, 0), len(stamps) - 1)] - self.start_ns) / SECOND_NS)

    def _give(self, until_ns: int) -> None:
        stop = min(bisect.bisect_right(self._stamps, until_ns), self._next + MOST_AT_ONCE)
        for message in self.messages[self._next : stop]:
            self._state.take(message.topic, message.type, message.data, message.received_ns)
        self._next = max(self._next, stop)

    def _all_events(self) -> list[Event]:
        """What the whole recording tells beside its numbers."""
        state = CellState(self.types, most_events=None)
        telling = ("/diagnostics", "/rosout", "/parameter_events", "/estop")
        for message in self.messages:
            if message.topic in telling or message.topic.endswith((ARM_STATUS.name, CONTROLLER_STATUS.name)):
                state.take(message.topic, message.type, message.data, message.received_ns)
        return list(state.events)
