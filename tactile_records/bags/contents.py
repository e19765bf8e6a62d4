"""What is in a bag: messages, topics, definitions, and what of it was not readable."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

Wanted = Callable[[str, str], bool]  # of topic and type: whether its messages are to be read


class BagError(ValueError):
    """A bag that cannot be written or read; the message names the file."""


class Recorded(NamedTuple):
    """One message: topic, type, raw CDR bytes, and when it was received and published (ns)."""

    topic: str
    type: str
    data: bytes
    received_ns: int
    published_ns: int


class Gap(NamedTuple):
    """Messages of one publisher that did not reach the recorder.

    How many, and when the messages before and after them were published (ns); 0 where there was none.
    """

    topic: str
    messages: int
    after_ns: int
    before_ns: int


@dataclass
class Bag:
    """What could be read of a bag.

    Attributes
    ----------
    folder : Path
    wanted : callable
        Whether the messages of a topic, by name and type, are kept; all are counted.
    messages : list of Recorded
        In the order of the files.
    note : dict
        What the writer was given to keep with the bag.
    definitions : dict
        Type -> text of its definition with all that it uses, where the bag holds it.
    types : dict
        Topic -> type, also of topics without messages.
    counts : dict
        Topic -> number of messages, also of those that are not kept.
    problems : list of str
        What could not be read, and where: a file is missing, ends early or holds damaged data.
    gaps : list of Gap
        What the recorder says that it missed.
    """

    folder: Path
    wanted: Wanted = lambda topic, type_name: True
    messages: list[Recorded] = field(default_factory=list)
    note: dict[str, str] = field(default_factory=dict)
    definitions: dict[str, str] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    gaps: list[Gap] = field(default_factory=list)

    @property
    def complete(self) -> bool:
        """Whether all of it could be read, and its recorder missed nothing."""
        return not self.problems and not self.gaps

    @property
    def problem(self) -> str:
        """What is missing and why; empty for a complete bag."""
        return "; ".join([*self.problems, *self._missed()])

    @property
    def lost(self) -> dict[str, int]:
        """Topic -> number of messages that were published and did not reach the recorder."""
        counts: Counter[str] = Counter()
        for gap in self.gaps:
            counts[gap.topic] += gap.messages
        return dict(counts)

    def _missed(self) -> Iterator[str]:
        """What the recorder missed, a text for each topic."""
        for topic, lost in self.lost.items():
            gaps = [gap for gap in self.gaps if gap.topic == topic]
            start_ns, end_ns = min(gap.after_ns for gap in gaps), max(gap.before_ns for gap in gaps)
            places = f" at {len(gaps)} places" if len(gaps) > 1 else ""
            yield (
                f"{topic}: {lost} of {lost + self.counts.get(topic, 0)} messages were published and not "
                f"recorded{places}, between {start_ns / 1e9:.3f} and {end_ns / 1e9:.3f} s (Unix time)"
            )

    def add_topic(self, topic: str, type_name: str) -> None:
        """A topic of the bag, which may be announced more than once."""
        self.types[topic] = type_name
        self.counts.setdefault(topic, 0)

    @property
    def read(self) -> int:
        """Number of messages so far, those that are not kept included."""
        return sum(self.counts.values())

    def decoded(self, topic: str) -> Iterator[tuple[Recorded, Any]]:
        """The messages of one topic, deserialised by the definitions in the bag."""
        store = self.typestore()
        for message in self.messages:
            if message.topic == topic:
                yield message, store.deserialize_cdr(message.data, message.type)

    @property
    def topics(self) -> dict[str, int]:
        """Topic -> number of messages, of the topics that have any."""
        return {topic: count for topic, count in self.counts.items() if count}

    def typestore(self) -> Any:
        """The types that the bag defines, for `rosbags`."""
        if not hasattr(self, "_store"):
            store = get_typestore(Stores.EMPTY)
            for name, text in self.definitions.items():
                types = get_types_from_msg(text, name)
                store.register({key: value for key, value in types.items() if key not in store.types})
            self._store = store
        return self._store
