"""Writes bags in the rosbag2 layout (one MCAP file and metadata.yaml in a folder); a kill costs little.

`ros2 bag`, Foxglove and `rosbags` open them: each topic carries its full message definition. Each `flush`
closes a chunk, so what was flushed can be read even when the file's end is missing. The counts and times of
metadata.yaml, which only describe the file, may then be up to `METADATA_PERIOD` old.
"""

from __future__ import annotations

import contextlib
import errno
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml
from mcap.writer import CompressionType, Writer

from tactile_base.topics import LATCHED, SENSOR, Topic
from tactile_records.bags.contents import BagError, Gap
from tactile_wire.message_definitions import message_definition, type_hash

__all__ = ["METADATA", "BagError", "BagWriter"]

METADATA = "metadata.yaml"
GAP = "messages_lost"  # name of the MCAP metadata records that tell what a recorder missed
METADATA_PERIOD = 10.0  # s; writing it takes 10 ms of a core that others are waiting for
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # the one in C takes a quarter of the time
_METADATA_VERSION = 9


@dataclass
class _Channel:
    topic: Topic
    id: int
    hash: str
    count: int = 0


@dataclass
class _Span:
    """First and last receive time (ns), and the number of messages."""

    first_ns: int = 2**63 - 1
    last_ns: int = 0
    count: int = 0

    def add(self, stamp_ns: int) -> None:
        self.first_ns, self.last_ns = min(self.first_ns, stamp_ns), max(self.last_ns, stamp_ns)
        self.count += 1

    @property
    def start_ns(self) -> int:
        return self.first_ns if self.count else 0

    @property
    def duration_ns(self) -> int:
        return max(0, self.last_ns - self.start_ns)


class BagWriter:
    """Writes raw (CDR) messages into a new bag.

    Parameters
    ----------
    folder : Path
        The bag; must not exist yet.
    topics : sequence of Topic
        All topics of the bag.
    definitions : mapping, optional
        Type name -> definition; by default those of the installed packages.
    note : mapping, optional
        Names and texts to keep with the bag (custom_data of metadata.yaml), as the scene and the task.

    Raises
    ------
    BagError
        The folder exists or cannot be written, as all that writes says as well: the disk is full.
    DefinitionMissing
        A type's .msg file is not installed.
    """

    def __init__(
        self,
        folder: Path,
        topics: Sequence[Topic],
        definitions: Mapping[str, str] | None = None,
        note: Mapping[str, str] | None = None,
    ) -> None:
        texts = {t.type: (definitions or {}).get(t.type) or message_definition(t.type) for t in topics}
        self.folder, self.note = folder, dict(note or {})
        self.file = folder / f"{folder.name}_0.mcap"
        self._span = _Span()
        try:
            folder.mkdir(parents=True)
            self._stream = self.file.open("wb")
        except FileExistsError as error:
            raise BagError(f"{folder} exists already; remove it or record elsewhere") from error
        except OSError as error:
            raise BagError(f"{folder}: cannot be created: {error.strerror}") from error
        with self._refusing():
            self._writer = Writer(self._stream, compression=CompressionType.ZSTD)
            self._writer.start(profile="ros2", library="tactile_servoing")
            self._channels = self._register(topics, texts)
            self._writer.flush()
            self._write_metadata()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def write(self, topic: str, data: bytes, received_ns: int, published_ns: int | None = None) -> None:
        """Add one message; without a time of publication that of reception stands in."""
        channel = self._channels[topic]
        channel.count += 1
        self._span.add(received_ns)
        published_ns = received_ns if published_ns is None else published_ns
        with self._refusing():
            self._writer.add_message(channel.id, received_ns, data, published_ns, sequence=channel.count)

    def add_gap(self, gap: Gap) -> None:
        """Note messages that were published and are not in the bag."""
        with self._refusing():
            self._writer.add_metadata(GAP, {name: str(value) for name, value in gap._asdict().items()})

    def flush(self) -> None:
        """Hand everything so far to the operating system: it survives the death of this process."""
        with self._refusing():
            self._writer.flush()
            self._look_for_file()
            if time.monotonic() - self._metadata_s > METADATA_PERIOD:
                self._write_metadata()

    def close(self) -> None:
        """Write index and footer; calling it again does nothing."""
        if self._stream.closed:
            return
        with self._refusing():
            self._writer.finish()
            self._stream.flush()
            self._look_for_file()
            self._stream.close()
            self._write_metadata()

    def _look_for_file(self) -> None:
        """Raise OSError for one that was deleted or moved: the system would go on taking what is written."""
        if not (self.file.exists() and os.fstat(self._stream.fileno()).st_nlink):
            raise FileNotFoundError(errno.ENOENT, "it was deleted or moved while it was being written")

    @contextlib.contextmanager
    def _refusing(self) -> Iterator[None]:
        """Make a `BagError` of what the operating system refuses, and write nothing after it."""
        try:
            yield
        except OSError as error:
            with contextlib.suppress(OSError):  # closing tries to write the rest once more
                self._stream.close()
            raise BagError(f"{self.file}: cannot be written: {error.strerror}") from error

    def _register(self, topics: Sequence[Topic], texts: Mapping[str, str]) -> dict[str, _Channel]:
        schemas = {
            name: self._writer.register_schema(name, "ros2msg", t.encode()) for name, t in texts.items()
        }
        hashes = {name: type_hash(name, text) for name, text in texts.items()}
        channels = {}
        for topic in topics:
            metadata = {
                "offered_qos_profiles": yaml.safe_dump([_qos(topic.qos)]),
                "topictype_hash": hashes[topic.type],
            }
            number = self._writer.register_channel(topic.name, "cdr", schemas[topic.type], metadata)
            channels[topic.name] = _Channel(topic, number, hashes[topic.type])
        return channels

    def _write_metadata(self) -> None:
        information = {"rosbag2_bagfile_information": self._information()}
        text = yaml.dump(information, Dumper=_DUMPER, sort_keys=False)
        self._metadata_s = time.monotonic()
        partial = self.folder / (METADATA + ".part")
        partial.write_text(text)
        partial.replace(self.folder / METADATA)  # a reader sees the old one or the new one, never half of it

    def _information(self) -> dict[str, Any]:
        start = {"nanoseconds_since_epoch": self._span.start_ns}
        duration = {"nanoseconds": self._span.duration_ns}
        count = self._span.count
        file = {"path": self.file.name, "starting_time": start, "duration": duration, "message_count": count}
        return {
            "version": _METADATA_VERSION,
            "storage_identifier": "mcap",
            "duration": dict(duration),
            "starting_time": dict(start),
            "message_count": count,
            "topics_with_message_count": [_topic_entry(channel) for channel in self._channels.values()],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self.file.name],
            "files": [file],
            "custom_data": self.note or None,
            "ros_distro": os.environ.get("ROS_DISTRO", "unknown"),
        }


def _topic_entry(channel: _Channel) -> dict[str, Any]:
    return {
        "topic_metadata": {
            "name": channel.topic.name,
            "type": channel.topic.type,
            "serialization_format": "cdr",
            "offered_qos_profiles": [_qos(channel.topic.qos)],
            "type_description_hash": channel.hash,
        },
        "message_count": channel.count,
    }


def _qos(name: str) -> dict[str, Any]:
    """One offered profile in rosbag2's YAML (version 9)."""
    unlimited = {"sec": 9223372036, "nsec": 854775807}
    return {
        "history": "keep_last",
        "depth": 1,
        "reliability": "best_effort" if name == SENSOR else "reliable",
        "durability": "transient_local" if name == LATCHED else "volatile",
        "deadline": dict(unlimited),
        "lifespan": dict(unlimited),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(unlimited),
        "avoid_ros_namespace_conventions": False,
    }
