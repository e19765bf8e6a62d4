"""Reads MCAP files, also damaged ones and those whose writer was killed: what is whole is read.

Records are read by `mcap`, whose own readers end at the first damage and make reading a bag two and a half
times as long. So the way from record to record is ours, and that from message to message within a chunk.
Types and topics are those of the summary at the file's end where that is whole, since the first chunk, which
has them too, may be damaged; of chunks that were not read it tells the time. Format: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from io import BytesIO
from typing import Protocol

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Metadata, MetadataIndex, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.well_known import SchemaEncoding
from mcap.writer import MCAP0_MAGIC

from tactile_records.bags.contents import Bag, Gap, Recorded
from tactile_records.bags.unpacking import MESSAGE_COST, TooLarge, Unpacker
from tactile_records.bags.writer import GAP

OPCODES = frozenset({*map(int, Opcode), *range(0x80, 0x100)})  # from 0x80 on they are private
_ANNOUNCING: dict[int, type[Schema | Channel]] = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel}
_MESSAGE_OPCODE = int(Opcode.MESSAGE)  # to compare with an enum takes longer
RECORD = struct.Struct("<BQ")  # opcode, length
MESSAGE = struct.Struct("<BQHIQQ")  # the same, then channel, sequence, time of reception, of publication
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the summary, of its offsets, checksum
# What reading a damaged record raises; ValueError includes wrong checksums and texts.
DAMAGE = (McapError, ValueError, LookupError, OverflowError, RuntimeError, struct.error, zstandard.ZstdError)
WITHOUT_FOOTER = "without its footer: its writer was killed, or still writes"


class Sliced(Protocol):
    """Bytes of a file, of which parts are taken."""

    def __len__(self) -> int: ...

    def __getitem__(self, part: slice, /) -> bytes: ...


class McapReader:
    """Reads one file into `bag`; `bag.problems` call it by `name`."""

    def __init__(self, data: Sliced, name: str, bag: Bag, unpacker: Unpacker) -> None:
        self._data, self._name, self._bag, self._unpacker = data, name, bag, unpacker
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, str, bool]] = {}  # topic, type, whether it is kept
        self._counts: Counter[int] = Counter()  # messages by channel
        self._chunks: dict[int, ChunkIndex] = {}  # by where they start; those that were read are taken out
        self._metadata: list[MetadataIndex] = []
        self._has_end = False
        self._statistics: Statistics | None = None

    def read(self) -> bool:
        """Read all that is readable; False if it is no MCAP file or holds nothing at all."""
        if not self._starts():
            return False
        self._read_summary()
        try:
            self._read_data()
        except TooLarge as error:
            self._report(str(error))
        self._report_missing()
        return bool(self._channels) or not self._bag.problems

    def _starts(self) -> bool:
        if starts := self._data[: len(MCAP0_MAGIC)] == MCAP0_MAGIC:
            return starts
        self._report("is not an MCAP file: it does not start as one")
        return False

    def _read_summary(self) -> None:
        """Types, topics, chunks and counts, where the end of the file is as it was written."""
        end = len(self._data) - len(MCAP0_MAGIC) - _FOOTER.size
        if end < len(MCAP0_MAGIC):
            return
        opcode, length, start, _, crc = _FOOTER.unpack(self._data[end : end + _FOOTER.size])
        if opcode != Opcode.FOOTER or length != _FOOTER.size - RECORD.size or not 0 < start <= end:
            return
        self._has_end = True
        if crc not in (0, zlib.crc32(self._data[start : end + _FOOTER.size - 4])):
            self._report_damage(start, "the summary has a wrong checksum")
            return
        try:
            for record in StreamReader(BytesIO(self._data[start:]), skip_magic=True).records:
                if isinstance(record, ChunkIndex):
                    self._chunks[record.chunk_start_offset] = record
                elif isinstance(record, Schema | Channel):
                    self._announce(record)
                elif isinstance(record, MetadataIndex):
                    self._metadata.append(record)
                elif isinstance(record, Statistics):
                    self._statistics = record
        except DAMAGE as error:
            self._report_damage(start, text_of(error))

    def _read_data(self) -> None:
        """All records; behind one that is none the summary tells where the next chunk starts."""
        starts, position = sorted(self._chunks, reverse=True), len(MCAP0_MAGIC)
        while position + RECORD.size <= len(self._data):
            while starts and starts[-1] <= position:
                starts.pop()
            opcode, length = RECORD.unpack(self._data[position : position + RECORD.size])
            at, position = position, position + RECORD.size + length
            if opcode not in OPCODES or position > (starts[-1] if starts else len(self._data)):
                if not self._has_end:
                    if opcode == Opcode.CHUNK:
                        self._take_part_of_chunk(at)
                    break
                self._report_damage(at, "no record of MCAP")
                position = starts[-1] if starts else len(self._data)
            elif opcode == Opcode.DATA_END:
                break
            else:
                try:
                    self._take(opcode, at, position)
                except TooLarge:
                    raise
                except DAMAGE as error:
                    self._report_damage(at, text_of(error))
        if not self._has_end:
            end = f"after {len(self._data)} bytes and {WITHOUT_FOOTER}"
            self._report(f"the file ends early, {end}; {self._read_so_far}")

    def _take(self, opcode: int, at: int, stop: int) -> None:
        content = ReadDataStream(BytesIO(self._data[at + RECORD.size : stop]))
        if opcode == Opcode.MESSAGE or opcode in _ANNOUNCING:
            self._take_records(self._data[at:stop])
        elif opcode == Opcode.CHUNK:
            chunk = Chunk.read(content)
            data = self._unpacker.unpack(chunk.data, chunk.compression)
            if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
                raise McapError("wrong checksum")
            self._take_records(data)
            self._chunks.pop(at, None)
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(content)
            if metadata.name == GAP:
                values = metadata.metadata
                self._bag.gaps.append(Gap(values["topic"], *(int(values[name]) for name in Gap._fields[1:])))

    def _take_part_of_chunk(self, at: int) -> None:
        """What can be unpacked of the chunk that the end of the file cuts; it may be all there is."""
        rest = self._data[at + RECORD.size :]
        stream = ReadDataStream(BytesIO(rest))
        try:
            stream.read(8 + 8 + 8 + 4)  # first and last time, size, checksum
            compression = stream.read_prefixed_string()
            stream.read8()  # length of the data
            data = self._unpacker.unpack(rest[stream.count :], compression, part=True)
            self._take_records(data)
        except TooLarge:
            raise
        except DAMAGE:
            return  # the early end is reported all the same, and nothing of it counts as read

    def _take_records(self, data: bytes) -> None:
        """The records in a chunk: nearly all are messages, and this loop is what reading a bag costs."""
        bag, channels = self._bag, self._channels
        keep, counts, before = bag.messages.append, dict.fromkeys(channels, 0), len(bag.messages)
        position, end = 0, len(data)
        data += bytes(MESSAGE.size)  # a short last record is unpacked like all others
        while position < end:
            opcode, length, channel, _, received_ns, published_ns = MESSAGE.unpack_from(data, position)
            start, position = position, position + RECORD.size + length
            if position > end:
                break
            if opcode == _MESSAGE_OPCODE:
                if channel not in channels:
                    continue  # its announcement was in a chunk that is damaged
                topic, type_name, kept = channels[channel]
                counts[channel] = counts.get(channel, 0) + 1
                if kept:
                    cdr = data[start + MESSAGE.size : position]
                    keep(Recorded(topic, type_name, cdr, received_ns, published_ns))
            elif opcode in _ANNOUNCING:
                stream = ReadDataStream(BytesIO(data[start + RECORD.size : position]))
                self._announce(_ANNOUNCING[opcode].read(stream))
        self._counts.update(counts)
        for channel, count in counts.items():
            bag.counts[channels[channel][0]] += count
        self._unpacker.take(MESSAGE_COST * (len(bag.messages) - before))

    def _announce(self, record: Schema | Channel) -> None:
        """A type or a topic; the first announcement holds."""
        if isinstance(record, Schema):
            if record.id not in self._schemas and record.encoding == SchemaEncoding.ROS2:
                self._bag.definitions[record.name] = record.data.decode()
            self._schemas.setdefault(record.id, record.name)
        elif record.id not in self._channels:
            topic, type_name = record.topic, self._schemas.get(record.schema_id, "")
            self._channels[record.id] = topic, type_name, self._bag.wanted(topic, type_name)
            self._bag.add_topic(topic, type_name)

    def _report_missing(self) -> None:
        """How many messages of each topic are missing, and from when, by the summary."""
        counts = self._statistics.channel_message_counts if self._statistics else {}
        missing = [
            f"{self._counts[channel]} of {count} on {self._channels[channel][0]}"
            for channel, count in counts.items()
            if self._counts[channel] < count and channel in self._channels
        ]
        if not missing:
            return
        text = f"messages that were read: {', '.join(missing)}"
        if lost := self._chunks.values():
            start_ns = min(chunk.message_start_time for chunk in lost)
            end_ns = max(chunk.message_end_time for chunk in lost)
            text += f"; the others are from {start_ns / 1e9:.3f} to {end_ns / 1e9:.3f} s (Unix time)"
        self._report(text)

    def _report(self, text: str) -> None:
        self._bag.problems.append(f"{self._name}: {text}")

    def _report_damage(self, at: int, what: str) -> None:
        self._report(f"damaged near byte {at} of {len(self._data)}: {what}; {self._read_so_far}")

    @property
    def _read_so_far(self) -> str:
        return f"{self._bag.read} messages before that were read"


def text_of(error: Exception) -> str:
    return str(error) or type(error).__name__
