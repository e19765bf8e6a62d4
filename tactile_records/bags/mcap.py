"""Reads MCAP files, also damaged ones and those whose writer was killed: what is whole is read.

Records are read by `mcap`. Its readers end at the first damage, with all that is behind it, and give nothing
of the chunk that the end of a file cuts, which in bags of `ros2 bag` is most of a megabyte. So the way from
record to record is our own, and so is that from message to message within a chunk: theirs makes reading a bag
two and a half times as long. Types and topics are those of the summary at the file's end where that is whole,
since the first chunk, which has them too, may be damaged; of chunks that were not read it tells the time.
Format: https://mcap.dev/spec
"""

from __future__ import annotations

import mmap
import struct
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from io import BytesIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Metadata, Schema, Statistics
from mcap.well_known import SchemaEncoding
from mcap.writer import MCAP0_MAGIC

from tactile_records.bags.contents import Bag, Gap, Recorded
from tactile_records.bags.unpacking import MESSAGE_COST, TooLarge, Unpacker
from tactile_records.bags.writer import GAP

_OPCODES, _FIRST_PRIVATE_OPCODE = frozenset(map(int, Opcode)), 0x80
_MESSAGE_OPCODE = int(Opcode.MESSAGE)  # to compare with an enum takes longer
_RECORD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<BQHIQQ")  # the same, then channel, sequence, time of reception, of publication
_CHUNK = struct.Struct("<QQQII")  # first and last time, size, checksum, length of the compression's name
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the summary, of its offsets, checksum
_LENGTH = struct.Struct("<Q")
# What reading a damaged record raises; ValueError includes wrong checksums and texts.
_DAMAGE = (McapError, ValueError, LookupError, OverflowError, RuntimeError, struct.error, zstandard.ZstdError)


class McapReader:
    """Reads one file into `bag`; `bag.problems` call it by `name`."""

    def __init__(self, data: mmap.mmap, name: str, bag: Bag, unpacker: Unpacker) -> None:
        self._data, self._name, self._bag, self._unpacker = data, name, bag, unpacker
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, str, bool]] = {}  # topic, type, whether it is kept
        self._counts: Counter[int] = Counter()  # messages by channel
        self._unannounced: Counter[int] = Counter()
        self._chunks: list[ChunkIndex] = []  # by the summary, in the order of the file
        self._starts: list[int] = []  # of these
        self._has_end = False
        self._read_chunks: set[int] = set()  # offsets
        self._statistics: Statistics | None = None

    def read(self) -> bool:
        """Read all that is readable; False if it is no MCAP file or holds nothing at all."""
        if self._data[: len(MCAP0_MAGIC)] != MCAP0_MAGIC:
            if self._data[-len(MCAP0_MAGIC) :] != MCAP0_MAGIC:
                self._report("is not an MCAP file: it does not start as one")
                return False
            self._report_damage(0, "it does not start as an MCAP file, and ends as one")
        self._read_summary()
        position: int | None = len(MCAP0_MAGIC)
        try:
            while position is not None:
                position = self._read_from(position)
        except TooLarge as error:
            self._report(str(error))
        self._report_unannounced()
        self._report_missing()
        return bool(self._channels) or not self._bag.problems

    # ---- the summary ----

    def _read_summary(self) -> None:
        """Types, topics, chunks and counts, where the end of the file is as it was written."""
        end = len(self._data) - len(MCAP0_MAGIC) - _FOOTER.size
        if end < len(MCAP0_MAGIC):
            return
        opcode, length, start, _, crc = _FOOTER.unpack_from(self._data, end)
        if opcode != Opcode.FOOTER or length != _FOOTER.size - _RECORD.size or not 0 < start <= end:
            return
        self._has_end = True
        whole = crc in (0, zlib.crc32(self._data[start : end + _FOOTER.size - 4]))
        if not whole:
            self._report_damage(start, "the summary has a wrong checksum")
        for at, opcode, stop in _records(self._data[start:end]):
            content = ReadDataStream(BytesIO(self._data[start + at + _RECORD.size : start + stop]))
            try:
                if opcode == Opcode.CHUNK_INDEX:
                    self._add_chunk(ChunkIndex.read(content))
                elif whole and opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._announce(opcode, content)
                elif whole and opcode == Opcode.STATISTICS:
                    self._statistics = Statistics.read(content)
            except _DAMAGE as error:
                self._report_damage(start + at, _text(error))
        self._chunks.sort(key=lambda chunk: chunk.chunk_start_offset)
        self._starts = [chunk.chunk_start_offset for chunk in self._chunks]

    def _add_chunk(self, chunk: ChunkIndex) -> None:
        """A chunk, if opcode or length say so there as well: the summary may be damaged, too."""
        start = chunk.chunk_start_offset
        if start + _RECORD.size <= len(self._data):
            opcode, length = _RECORD.unpack_from(self._data, start)
            if opcode == Opcode.CHUNK or length + _RECORD.size == chunk.chunk_length:
                self._chunks.append(chunk)

    # ---- the data ----

    def _read_from(self, position: int) -> int | None:
        """Read records until the end or the next damaged one; where to go on after that, None for nowhere."""
        for at, opcode, stop in _records(self._data, position):
            following = self._next_chunk(at)
            known = opcode in _OPCODES or opcode >= _FIRST_PRIVATE_OPCODE
            if not known or stop > (len(self._data) if following is None else following):
                return self._leave(at, opcode, following)
            if opcode == Opcode.FOOTER or (opcode == Opcode.DATA_END and self._has_end):
                return None
            try:
                self._take(opcode, at, stop)
            except TooLarge:
                raise
            except _DAMAGE as error:
                self._report_damage(at, _text(error))
        self._report_early_end()
        return None

    def _next_chunk(self, at: int) -> int | None:
        """Where the next chunk behind a place starts, by the summary."""
        place = bisect_right(self._starts, at)
        return self._starts[place] if place < len(self._starts) else None

    def _leave(self, at: int, opcode: int, following: int | None) -> int | None:
        """What stands here is no record, or one that the end of the file cuts."""
        if self._has_end:
            self._report_damage(at, "no record of MCAP")
            return following
        if opcode == Opcode.CHUNK:
            self._take_part_of_chunk(at)
        self._report_early_end()
        return None

    def _take(self, opcode: int, at: int, stop: int) -> None:
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            self._take_records(self._data[at:stop])
        elif opcode == Opcode.CHUNK:
            self._take_chunk(at, stop)
        elif opcode == Opcode.METADATA:
            self._take_metadata(Metadata.read(ReadDataStream(BytesIO(self._data[at + _RECORD.size : stop]))))

    def _take_chunk(self, at: int, stop: int) -> None:
        size, crc, compression, packed = self._chunk(at, stop)
        with packed:
            if compression == "zstd":
                data = self._unpacker.zstd(packed, size)
            elif compression == "lz4":
                data = self._unpacker.lz4(packed)
            elif compression:
                raise McapError(f"compression '{compression}' is not known")
            else:
                data = bytes(packed)
        if crc not in (0, zlib.crc32(data)):
            raise McapError("wrong checksum")
        self._read_chunks.add(at)
        self._take_records(data)

    def _take_part_of_chunk(self, at: int) -> None:
        """What can be decompressed of the chunk that the end of the file cuts."""
        try:
            _, _, compression, packed = self._chunk(at, len(self._data))
            with packed:
                self._take_records(self._unpacker.part(packed, compression))
        except TooLarge:
            raise
        except _DAMAGE:
            return  # the early end is reported all the same, and nothing of it counts as read

    def _chunk(self, at: int, stop: int) -> tuple[int, int, str, memoryview]:
        """Size, checksum, compression and compressed data of a chunk."""
        at += _RECORD.size
        _, _, size, crc, length = _CHUNK.unpack_from(self._data, at)
        at += _CHUNK.size
        compression = str(self._data[at : min(at + length, stop)], "utf-8")
        at += length
        (length,) = _LENGTH.unpack_from(self._data, at)
        at += _LENGTH.size
        return size, crc, compression, memoryview(self._data)[at : min(at + length, stop)]

    def _take_records(self, data: bytes) -> None:
        """The records in a chunk: nearly all are messages, and this loop is what reading a bag costs."""
        bag, channels = self._bag, self._channels
        keep, counts, before = bag.messages.append, dict.fromkeys(channels, 0), len(bag.messages)
        position, end, last = 0, len(data), len(data) - _MESSAGE.size
        while position < end:
            record = data[position:].ljust(_MESSAGE.size, b"\0") if position > last else None
            opcode, length, channel, _, received_ns, published_ns = (
                _MESSAGE.unpack_from(data, position) if record is None else _MESSAGE.unpack_from(record)
            )
            start, position = position, position + _RECORD.size + length
            if position > end:
                break
            if opcode == _MESSAGE_OPCODE:
                if channel not in channels:
                    self._unannounced[channel] += 1
                    continue
                topic, type_name, kept = channels[channel]
                counts[channel] = counts.get(channel, 0) + 1
                if kept:
                    cdr = data[start + _MESSAGE.size : position]
                    keep(Recorded(topic, type_name, cdr, received_ns, published_ns))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._announce(opcode, ReadDataStream(BytesIO(data[start + _RECORD.size : position])))
        self._counts.update(counts)
        for channel, count in counts.items():
            bag.counts[channels[channel][0]] += count
        self._unpacker.take(MESSAGE_COST * (len(bag.messages) - before))

    def _take_metadata(self, metadata: Metadata) -> None:
        if metadata.name == GAP:
            values = metadata.metadata
            numbers = (int(values[name]) for name in Gap._fields[1:])
            self._bag.gaps.append(Gap(values["topic"], *numbers))

    def _announce(self, opcode: int, stream: ReadDataStream) -> None:
        """A type or a topic; the first announcement holds."""
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            if schema.id not in self._schemas and schema.encoding == SchemaEncoding.ROS2:
                self._bag.definitions[schema.name] = schema.data.decode()
            self._schemas.setdefault(schema.id, schema.name)
            return
        channel = Channel.read(stream)
        if channel.id not in self._channels:
            topic, type_name = channel.topic, self._schemas.get(channel.schema_id, "")
            self._channels[channel.id] = topic, type_name, self._bag.wanted(topic, type_name)
            self._bag.add_topic(topic, type_name)

    # ---- what was not read ----

    def _report_missing(self) -> None:
        """How many messages of each topic are missing, and from when, by the summary."""
        if self._statistics is None:
            return
        missing = [
            f"{self._counts[channel]} of {count} on {self._channels[channel][0]}"
            for channel, count in self._statistics.channel_message_counts.items()
            if self._counts[channel] < count and channel in self._channels
        ]
        lost = [chunk for chunk in self._chunks if chunk.chunk_start_offset not in self._read_chunks]
        if not missing:
            return
        text = f"messages that were read: {', '.join(missing)}"
        if lost:
            start_ns = min(chunk.message_start_time for chunk in lost)
            end_ns = max(chunk.message_end_time for chunk in lost)
            text += f"; the others are from {start_ns / 1e9:.3f} to {end_ns / 1e9:.3f} s (Unix time)"
        self._report(text)

    def _report_unannounced(self) -> None:
        for channel, count in self._unannounced.items():
            self._report(f"{count} messages of channel {channel}, which was not announced")

    def _report(self, text: str) -> None:
        self._bag.problems.append(f"{self._name}: {text}")

    def _report_damage(self, at: int, what: str) -> None:
        read = f"{self._bag.read} messages before that were read"
        self._report(f"damaged near byte {at} of {len(self._data)}: {what}; {read}")

    def _report_early_end(self) -> None:
        read = f"{self._bag.read} messages before that were read"
        without = "without its footer: its writer was killed"
        self._report(f"the file ends early, after {len(self._data)} bytes and {without}; {read}")


def _records(data: mmap.mmap | bytes, position: int = 0) -> Iterator[tuple[int, int, int]]:
    """Offset and opcode of each record, and where the next one starts; that may lie past the end."""
    while position + _RECORD.size <= len(data):
        opcode, length = _RECORD.unpack_from(data, position)
        yield position, opcode, position + _RECORD.size + length
        position += _RECORD.size + length


def _text(error: Exception) -> str:
    return str(error) or type(error).__name__
