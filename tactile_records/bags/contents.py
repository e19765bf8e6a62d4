"""What is in a bag: messages, topics, definitions, and what of it was not readable."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.serde import SerdeError

from tactile_base.input_file import parse_json
from tactile_wire.errors import DefinitionDamaged
from tactile_wire.message_definitions import message_definition, typestore

# What `rosbags` raises for bytes that are no message of their type.
_NO_MESSAGE = (SerdeError, struct.error, ValueError, LookupError, TypeError, AssertionError, OverflowError)
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


UNKNOWN = 0  # messages of a gap at the end of what a publisher sent


class Gap(NamedTuple):
    """Messages of one publisher that did not reach the recorder.

    How many, and when the messages before and after them were published (ns). Where nothing more came of a
    publisher after the recorder was held up, `messages` is `UNKNOWN`, and `before_ns` the end of that.
    """

    topic: str
    messages: int
    after_ns: int
    before_ns: int

    def __str__(self) -> str:
        return f"{self.topic}: {gap_text(self.messages, self.after_ns, self.before_ns)}"


def gap_text(messages: int, after_ns: int, before_ns: int, of: int = 0) -> str:
    """What is missing, of so many messages where that is known, and from when."""
    when = f"between {after_ns / 1e9:.3f} and {before_ns / 1e9:.3f} s (Unix time)"
    if messages == UNKNOWN:
        return f"what was published {when} may be missing: the recorder was held up"
    return f"{messages}{f' of {of}' if of else ''} messages were published and not recorded, {when}"


def noted(note: Mapping[str, str], name: str) -> dict[str, dict[str, Any]]:
    """What a bag's note holds by name as JSON: mappings by node or arm; empty without it.

    Raises
    ------
    BagError
        If it holds anything else.
    """
    try:
        found = parse_json(note.get(name, "{}"))
    except ValueError as error:
        raise BagError(f"the bag's note '{name}' is no JSON: {error}") from error
    if not isinstance(found, dict) or not all(isinstance(value, dict) for value in found.values()):
        raise BagError(f"the bag's note '{name}': must hold mappings by name")
    return found


def everything(topic: str, type_name: str) -> bool:
    """Keeps the messages of all topics."""
    return True


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
    wanted: Wanted = everything
    messages: list[Recorded] = field(default_factory=list)
    note: dict[str, str] = field(default_factory=dict)
    definitions: dict[str, str] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    gaps: list[Gap] = field(default_factory=list)
    _stores: dict[str, Any] = field(default_factory=dict)

    def without_messages(self) -> Bag:
        """What is left to be sent to another process, where the messages are not needed."""
        return replace(self, wanted=everything, messages=[], _stores={})

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
            span = min(gap.after_ns for gap in gaps), max(gap.before_ns for gap in gaps)
            places = f" ({len(gaps)} gaps)" if len(gaps) > 1 else ""
            count = self.counts.get(topic, 0)  # of none, nobody may have counted them
            yield f"{topic}: {gap_text(lost, *span, of=lost + count if count else 0)}{places}"

    def add_topic(self, topic: str, type_name: str) -> None:
        """A topic of the bag, which may be announced more than once."""
        self.types[topic] = type_name
        self.counts.setdefault(topic, 0)

    @property
    def read(self) -> int:
        """Number of messages so far, those that are not kept included."""
        return sum(self.counts.values())

    def decoded(self, topic: str) -> Iterator[tuple[Recorded, Any]]:
        """The messages of one topic, deserialised by the definitions in the bag; others are problems."""
        damaged = []
        for message in self.messages:
            if message.topic == topic:
                try:
                    value = self.typestore(message.type).deserialize_cdr(message.data, message.type)
                except _NO_MESSAGE as error:
                    damaged.append(f"at {message.received_ns} ns: {error or type(error).__name__}")
                else:
                    yield message, value
        if damaged:
            self.problems.append(
                f"{topic}: {len(damaged)} messages cannot be decoded, the first {damaged[0]}"
            )

    @property
    def topics(self) -> dict[str, int]:
        """Topic -> number of messages, of the topics that have any."""
        return {topic: count for topic, count in self.counts.items() if count}

    def typestore(self, type_name: str) -> Any:
        """A type with all that it uses, for `rosbags`: as the bag defines it, else as it is installed.

        Raises `DefinitionMissing` where it is neither.
        """
        if type_name not in self._stores:
            self._stores[type_name] = self._defined(type_name) or typestore(
                type_name, message_definition(type_name)
            )
        return self._stores[type_name]

    def _defined(self, type_name: str) -> Any:
        text = self.definitions.get(type_name)
        try:
            return typestore(type_name, text) if text else None
        except DefinitionDamaged as error:
            self.problems.append(f"the definition of {type_name} {error}; the installed one is taken")
            return None
