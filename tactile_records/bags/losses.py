"""What a recorder misses, by the numbers that publishers give their messages, and by how long it was held up.

No number tells what a publisher sent last. One that is still there a while after the recorder was held up has
sent again what was missed; of one that is not, and was not heard again, no more is known than from when on
messages may be missing.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from tactile_base.stamps import SECOND_NS
from tactile_records.bags.contents import UNKNOWN, Gap

LATE_NS = SECOND_NS // 2  # from publication, after which a message shows that more are on their way
CAUGHT_UP_NS = 4 * SECOND_NS  # longer than the heartbeats by which DDS offers again what was missed (3 s)
STEADY_NS, STEADY_COUNT = SECOND_NS // 2, 10  # between the messages of a publisher that would be missed


@dataclass
class _Sender:
    """One publisher of a topic: its newest number, when it published (ns), and when it was there (ns)."""

    number: int
    first_ns: int
    last_ns: int
    count: int = 1
    present_ns: int = 0

    @property
    def steady(self) -> bool:
        """Whether it published all the time, so that its silence says something."""
        return self.count > STEADY_COUNT and self.last_ns - self.first_ns < self.count * STEADY_NS


class Losses:
    """Looks at every message; all times are of the system's clock, in ns.

    Attributes
    ----------
    lost : Counter
        Topic -> messages that are known to be missing.
    late : set of str
        Topics whose newest message came late, so that more are on their way.
    """

    def __init__(self) -> None:
        self.lost: Counter[str] = Counter()
        self.late: set[str] = set()
        self._senders: dict[tuple[str, bytes], _Sender] = {}
        self._held_up: list[tuple[int, int]] = []

    def seen(self, topic: str, publisher: bytes, number: int, published_ns: int) -> Gap | None:
        """A message has come; returns what is missing before it."""
        known = self._senders.get((topic, publisher))
        if known is None:
            self._senders[topic, publisher] = _Sender(number, published_ns, published_ns)
            return None
        missing, last_ns = number - known.number - 1, known.last_ns
        known.number, known.last_ns, known.count = number, published_ns, known.count + 1
        return self.miss(topic, missing, last_ns, published_ns) if missing > 0 else None

    def delay(self, topic: str, delay_ns: int) -> None:
        """How long a message was on its way."""
        (self.late.add if delay_ns > LATE_NS else self.late.discard)(topic)

    def miss(self, topic: str, messages: int, after_ns: int, before_ns: int) -> Gap:
        """Count messages that are missing."""
        self.lost[topic] += messages
        return Gap(topic, messages, after_ns, before_ns)

    def held_up(self, start_ns: int, end_ns: int) -> None:
        """The recorder did nothing in between."""
        self._held_up.append((start_ns, end_ns))

    def in_doubt(self, now_ns: int) -> set[str]:
        """Topics with publishers that must have sent again what was missed, if they are still there."""
        return {
            topic
            for (topic, _), sender in self._senders.items()
            if any(now_ns > end_ns + CAUGHT_UP_NS for end_ns in self._doubts(sender))
        }

    def present(self, topic: str, publishers: set[bytes], now_ns: int) -> None:
        """These publishers of a topic are there."""
        for (name, publisher), sender in self._senders.items():
            if name == topic and publisher in publishers:
                sender.present_ns = now_ns

    def last(self, told: Counter[str], now_ns: int) -> list[Gap]:
        """At the end: what is missing behind the last message of a publisher.

        Parameters
        ----------
        told : Counter
            Topic -> messages that the middleware says to have lost.
        """
        more = {topic: count - self.lost[topic] for topic, count in told.items()}
        gaps = [self.miss(topic, n, self._newest_ns(topic), now_ns) for topic, n in more.items() if n > 0]
        for (topic, _), sender in self._senders.items():
            gaps += [Gap(topic, UNKNOWN, sender.last_ns, end_ns) for end_ns in self._doubts(sender)]
        return gaps

    def _doubts(self, sender: _Sender) -> list[int]:
        """Ends of the times after which it is not known whether all has come that it sent."""
        return [
            end_ns
            for start_ns, end_ns in self._held_up
            if sender.steady
            and start_ns - SECOND_NS < sender.last_ns < end_ns
            and sender.present_ns <= end_ns + CAUGHT_UP_NS
        ]

    def on_their_way(self, now_ns: int) -> list[Gap]:
        """What there was no time to wait for."""
        return [Gap(topic, UNKNOWN, self._newest_ns(topic), now_ns) for topic in sorted(self.late)]

    def _newest_ns(self, topic: str) -> int:
        return max((each.last_ns for (name, _), each in self._senders.items() if name == topic), default=0)
