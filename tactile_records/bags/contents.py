"""What readers of bag files fill in: messages, topics, definitions, and what of the file was not readable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

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
class Contents:
    """What was read of a bag's files.

    Attributes
    ----------
    wanted : callable
        Whether the messages of a topic, by name and type, are kept; all are counted.
    messages : list of Recorded
        In the order of the file.
    types : dict
        Topic -> type, also of topics without messages.
    counts : dict
        Topic -> number of messages.
    definitions : dict
        Type -> text of its definition with all that it uses, where the bag holds it.
    problems : list of str
        What could not be read, and where.
    """

    wanted: Wanted = lambda topic, type_name: True
    messages: list[Recorded] = field(default_factory=list)
    types: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    definitions: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    def add_topic(self, topic: str, type_name: str) -> None:
        """A topic of the bag, which may be announced more than once."""
        self.types[topic] = type_name
        self.counts.setdefault(topic, 0)

    @property
    def read(self) -> int:
        """Number of messages so far, those that are not kept included."""
        return sum(self.counts.values())
