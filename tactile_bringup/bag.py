"""Reads bags (rosbag2 layout, MCAP) message by message, also those whose writer was killed."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import yaml
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zstandard import ZstdError

from tactile_bringup.bag_writer import METADATA, BagError


@dataclass(frozen=True)
class Recorded:
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
        The bag.
    complete : bool
        False where the file ends early or holds damaged data.
    problem : str
        What is missing and why; empty for a complete bag.
    messages : list of Recorded
        In the order of the file.
    note : dict
        What the writer was told to keep with the bag.
    """

    folder: Path
    complete: bool = True
    problem: str = ""
    messages: list[Recorded] = field(default_factory=list)
    note: dict[str, str] = field(default_factory=dict)
    definitions: dict[str, str] = field(default_factory=dict)

    def decoded(self, topic: str) -> Iterator[tuple[Recorded, Any]]:
        """The messages of one topic, deserialised by the definitions in the bag."""
        store = self._typestore()
        for message in self.messages:
            if message.topic == topic:
                yield message, store.deserialize_cdr(message.data, message.type)

    @property
    def topics(self) -> dict[str, int]:
        """Topic -> number of messages."""
        counts: dict[str, int] = {}
        for message in self.messages:
            counts[message.topic] = counts.get(message.topic, 0) + 1
        return counts

    def _typestore(self) -> Any:
        if not hasattr(self, "_store"):
            store = get_typestore(Stores.EMPTY)
            for name, text in self.definitions.items():
                types = get_types_from_msg(text, name)
                store.register({key: value for key, value in types.items() if key not in store.types})
            self._store = store
        return self._store


def read_bag(folder: Path) -> Bag:
    """Read a bag, also one whose writer was killed.

    Raises
    ------
    BagError
        There is no bag at that place, or nothing in it can be read.
    """
    file = _mcap_file(folder)
    bag = Bag(file.parent if folder.is_file() else folder)
    bag.note = _read_note(bag.folder)
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with file.open("rb") as stream:
        reader = StreamReader(stream, validate_crcs=True)
        try:
            for record in reader.records:
                _take(record, bag, schemas, channels)
        except (McapError, ZstdError, struct.error, ValueError) as error:
            bag.complete = False
            bag.problem = _problem(file, stream, bag, error)
    if not channels and not bag.complete:
        raise BagError(f"{file}: nothing in it can be read ({bag.problem})")
    return bag


def _take(record: object, bag: Bag, schemas: dict[int, Schema], channels: dict[int, Channel]) -> None:
    if isinstance(record, Schema):
        schemas[record.id] = record
        bag.definitions[record.name] = record.data.decode()
    elif isinstance(record, Channel):
        channels[record.id] = record
    elif isinstance(record, Message):
        channel = channels[record.channel_id]
        type_name = schemas[channel.schema_id].name
        bag.messages.append(
            Recorded(channel.topic, type_name, record.data, record.log_time, record.publish_time)
        )


def _problem(file: Path, stream: BinaryIO, bag: Bag, error: Exception) -> str:
    size = file.stat().st_size
    until = f"; {len(bag.messages)} messages before that were read"
    if isinstance(error, EndOfFile) or stream.tell() >= size:
        return f"the file ends early, after {size} bytes and without its footer: its writer was killed{until}"
    return f"damaged near byte {stream.tell()} of {size}: {error}{until}"


def _mcap_file(folder: Path) -> Path:
    if folder.is_file():
        return folder
    if not folder.is_dir():
        raise BagError(f"{folder}: no such bag")
    files = sorted(folder.glob("*.mcap"))
    if len(files) != 1:
        raise BagError(f"{folder}: holds {len(files)} .mcap files, must hold one")
    return files[0]


def _read_note(folder: Path) -> dict[str, str]:
    metadata = folder / METADATA
    if not metadata.is_file():
        return {}
    information = yaml.safe_load(metadata.read_text())["rosbag2_bagfile_information"]
    return dict(information.get("custom_data") or {})
