"""What is in a bag: messages, topics, definitions, and what of it was not readable."""

from __future__ import annotations

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
    """

    folder: Path
    wanted: Wanted = lambda topic, type_name: True
    messages: list[Recorded] = field(default_factory=list)
    note: dict[str, str] = field(default_factory=dict)
    definitions: dict[str, str] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    @property
    def complete(self) -> bool:
        """Whether all of it could be read."""
        return not self.problems

    @property
    def problem(self) -> str:
        """What is missing and why; empty for a complete bag."""
        return "; ".join(self.problems)

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
