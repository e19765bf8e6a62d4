"""Reads MCAP files, also damaged ones and those whose writer was killed: what is whole is read.

Records, compression and checksums are read by `mcap`. Its readers end at the first damage, with all that is
behind it, and give nothing of the chunk that the end of a file cuts, which in bags of `ros2 bag` is most of a
megabyte. So the way from record to record is our own, and so is that from message to message within a chunk:
theirs makes reading a bag two and a half times as long. Format: https://mcap.dev/spec
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from io import BytesIO
from typing import IO, cast

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Schema, Statistics
from mcap.stream_reader import get_chunk_data_stream
from mcap.well_known import SchemaEncoding
from mcap.writer import MCAP0_MAGIC

from tactile_records.bags.contents import Bag, Recorded

_OPCODES, _FIRST_PRIVATE_OPCODE = frozenset(map(int, Opcode)), 0x80
_MESSAGE_OPCODE = int(Opcode.MESSAGE)  # to compare with an enum takes longer
_RECORD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<BQHIQQ")  # the same, then channel, sequence, time of reception, of publication
# What reading a damaged record raises; ValueError includes wrong checksums and texts.
_DAMAGE = (McapError, ValueError, LookupError, OverflowError, RuntimeError, struct.error, zstandard.ZstdError)


class McapReader:
    """Reads one file into `bag`; `bag.problems` call it by `name`."""

    def __init__(self, data: mmap.mmap, name: str, bag: Bag) -> None:
        self._data, self._name, self._bag = data, name, bag
        self._stream = cast(IO[bytes], data)  # the same, for mcap
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, str, bool]] = {}  # topic, type, whether it is kept
        self._before = bag.read

    def read(self) -> bool:
        """Read all that is readable; False if it is no MCAP file or holds nothing at all."""
        if self._data[: len(MCAP0_MAGIC)] != MCAP0_MAGIC:
            self._report("is not an MCAP file: it does not start as one")
            return False
        position: int | None = len(MCAP0_MAGIC)
        while position is not None:
            position = self._read_from(position)
        return bool(self._channels) or not self._bag.problems

    def _read_from(self, position: int) -> int | None:
        """Read records until the end or the next damaged one; where to go on after that, None for nowhere."""
        for at, opcode, stop in _records(self._data, position):
            if stop > len(self._data) or not (opcode in _OPCODES or opcode >= _FIRST_PRIVATE_OPCODE):
                return self._leave(at, opcode)
            if opcode == Opcode.FOOTER:
                return None
            try:
                self._take(opcode, at, stop)
            except _DAMAGE as error:
                self._report_damage(at, str(error) or type(error).__name__)
        self._report_early_end()
        return None

    def _leave(self, at: int, opcode: int) -> int | None:
        """What follows is no record, or one that the end of the file cuts."""
        try:
            self._stream.seek(0)
            summary = SeekingReader(self._stream, record_size_limit=len(self._data)).get_summary()
        except _DAMAGE:
            summary = None
        if summary is None or not summary.chunk_indexes:
            if opcode == Opcode.CHUNK:
                self._take_part_of_chunk(at)
            self._report_early_end()
            return None
        self._report_damage(at, "no record of MCAP")
        offsets = [index.chunk_start_offset for index in summary.chunk_indexes]
        return min((offset for offset in offsets if offset > at), default=None)

    def _take(self, opcode: int, at: int, stop: int) -> None:
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            self._take_records(self._data[at:stop])
        elif opcode == Opcode.CHUNK:
            stream, size = get_chunk_data_stream(Chunk.read(self._content(at)), validate_crc=True)
            self._take_records(stream.read(size))
        elif opcode == Opcode.STATISTICS:
            self._compare(Statistics.read(self._content(at)))

    def _take_records(self, data: bytes) -> None:
        """The records in a chunk: nearly all are messages, and this loop is what reading a bag costs."""
        bag, channels = self._bag, self._channels
        keep, counts = bag.messages.append, dict.fromkeys(channels, 0)
        position, end, padded = 0, len(data), data + bytes(_MESSAGE.size)
        try:
            while position < end:
                opcode, length, channel, _, received_ns, published_ns = _MESSAGE.unpack_from(padded, position)
                start, position = position, position + _RECORD.size + length
                if position > end:
                    break
                if opcode == _MESSAGE_OPCODE:
                    topic, type_name, kept = channels[channel]
                    counts[channel] = counts.get(channel, 0) + 1
                    if kept:
                        cdr = data[start + _MESSAGE.size : position]
                        keep(Recorded(topic, type_name, cdr, received_ns, published_ns))
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._announce(opcode, ReadDataStream(BytesIO(data[start + _RECORD.size : position])))
        except KeyError as error:
            raise McapError(f"a message of channel {error}, which was not announced") from error
        finally:
            for channel, count in counts.items():
                bag.counts[channels[channel][0]] += count

    def _take_part_of_chunk(self, at: int) -> None:
        """What can be decompressed of the chunk that the end of the file cuts."""
        try:
            chunk = Chunk.read(self._content(at))
            if chunk.compression == "zstd":
                data = zstandard.ZstdDecompressor().decompressobj().decompress(chunk.data)
            elif chunk.compression == "lz4":
                data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data)
            else:
                data = chunk.data
            self._take_records(data)
        except _DAMAGE:
            return  # the early end is reported all the same, and nothing of it counts as read

    def _announce(self, opcode: int, stream: ReadDataStream) -> None:
        """A type or a topic; the summary repeats them, and only one of both may be damaged."""
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

    def _content(self, at: int) -> ReadDataStream:
        """What the record at this place holds, for the parsers of `mcap`."""
        self._stream.seek(at + _RECORD.size)
        return ReadDataStream(self._stream)

    def _compare(self, statistics: Statistics) -> None:
        """Damage that looks like a record of another kind shows in the count alone."""
        read = self._bag.read - self._before
        if read != statistics.message_count and not self._bag.problems:
            self._report(f"damaged: {read} of {statistics.message_count} messages were found")

    def _report(self, text: str) -> None:
        self._bag.problems.append(f"{self._name}: {text}")

    def _report_damage(self, at: int, what: str) -> None:
        read = f"{self._bag.read} messages before that were read"
        self._report(f"damaged near byte {at} of {len(self._data)}: {what}; {read}")

    def _report_early_end(self) -> None:
        read = f"{self._bag.read} messages before that were read"
        without = "without its footer: its writer was killed"
        self._report(f"the file ends early, after {len(self._data)} bytes and {without}; {read}")


def _records(data: mmap.mmap, position: int) -> Iterator[tuple[int, int, int]]:
    """Offset and opcode of each record, and where the next one starts; that may lie past the end."""
    while position + _RECORD.size <= len(data):
        opcode, length = _RECORD.unpack_from(data, position)
        yield position, opcode, position + _RECORD.size + length
        position += _RECORD.size + length
