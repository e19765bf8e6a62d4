"""Reads MCAP files, also damaged ones and those whose writer was killed: what is whole is read.

A reader of our own: of many topics a replay wants a few, a file without footer must still be read, and a
damaged chunk must not hide those behind it. Format: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import Any

import lz4.frame
import zstandard

from tactile_records.bags.contents import Contents, Recorded

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX, DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x08, 0x0F
_LAST_OPCODE, _FIRST_PRIVATE_OPCODE = 0x0F, 0x80

_RECORD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<BQHIQQ")  # the same, then channel, sequence, time of reception, of publication
_CHUNK = struct.Struct("<QQQII")  # first and last time, size, CRC, length of the compression's name
_FOOTER = struct.Struct("<QQI")  # start of the summary, of its offsets, CRC
_U16, _U32, _U64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")


class Damaged(ValueError):
    """A record that cannot be what was written; the message says why."""


class McapReader:
    """Reads one file into `contents`.

    Parameters
    ----------
    data : buffer
        The file.
    name : str
        What `contents.problems` calls it.
    """

    def __init__(self, data: Any, name: str, contents: Contents) -> None:
        self._data = memoryview(data)
        self._name = name
        self._contents = contents
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, str, bool]] = {}  # topic, type, whether it is kept

    def read(self) -> bool:
        """Read all that is readable; False if it is no MCAP file or holds nothing at all."""
        if bytes(self._data[: len(MAGIC)]) != MAGIC:
            self._complain("is not an MCAP file: it does not start as one")
            return False
        position: int | None = len(MAGIC)
        while position is not None:
            position = self._read_from(position)
        return bool(self._channels) or not self._contents.problems

    def _read_from(self, position: int) -> int | None:
        """Read records until the end or the next damaged one; where to go on after that, None for nowhere."""
        for at, opcode, start, stop in _records(self._data, position):
            if stop > len(self._data) or _LAST_OPCODE < opcode < _FIRST_PRIVATE_OPCODE or opcode == 0:
                return self._leave(at, opcode, start)
            position = stop
            try:
                self._take(opcode, start, stop)
            except (Damaged, struct.error, UnicodeDecodeError, zstandard.ZstdError, RuntimeError) as error:
                self._complain(
                    f"damaged near byte {at} of {len(self._data)}: {error or type(error).__name__}"
                )
            if opcode == FOOTER:
                return None
        self._complain_early_end()
        return None

    def _leave(self, at: int, opcode: int, start: int) -> int | None:
        """What follows is no record, or one that the end of the file cuts."""
        chunks = self._indexed_chunks()
        if not chunks:
            if opcode == CHUNK:
                self._take_part_of_chunk(start)
            self._complain_early_end()
            return None
        self._complain_damage(at, "no record of MCAP")
        return min((offset for offset in chunks if offset > at), default=None)

    def _take(self, opcode: int, start: int, stop: int) -> None:
        if opcode == CHUNK:
            self._take_records(self._chunk(start, stop))
        elif opcode == MESSAGE:
            self._take_records(bytes(self._data[start - _RECORD.size : stop]))
        elif opcode == SCHEMA:
            self._take_schema(self._data[start:stop])
        elif opcode == CHANNEL:
            self._take_channel(self._data[start:stop])

    def _take_records(self, data: bytes) -> None:
        """The records in a chunk: nearly all are messages, and this loop is what reading a bag costs."""
        contents, channels = self._contents, self._channels
        keep, counts = contents.messages.append, dict.fromkeys(channels, 0)
        position, end, header = 0, len(data), _MESSAGE.size
        try:
            while position + header <= end:
                opcode, length, channel, _, received_ns, published_ns = _MESSAGE.unpack_from(data, position)
                start, position = position, position + _RECORD.size + length
                if opcode == MESSAGE and position <= end:
                    topic, type_name, kept = channels.get(channel) or self._unknown(channel)
                    counts[channel] = counts.get(channel, 0) + 1
                    if kept:
                        cdr = data[start + header : position]
                        keep(Recorded(topic, type_name, cdr, received_ns, published_ns))
                elif opcode == SCHEMA:
                    self._take_schema(memoryview(data)[start + _RECORD.size : position])
                elif opcode == CHANNEL:
                    self._take_channel(memoryview(data)[start + _RECORD.size : position])
        finally:
            for channel, count in counts.items():
                contents.counts[channels[channel][0]] += count

    def _unknown(self, channel: int) -> tuple[str, str, bool]:
        raise Damaged(f"a message of channel {channel}, which was not announced")

    def _chunk(self, start: int, stop: int) -> bytes:
        """The records of a chunk, decompressed and checked."""
        _, _, size, crc, length = _CHUNK.unpack_from(self._data, start)
        begin = start + _CHUNK.size + length
        compression = bytes(self._data[begin - length : begin]).decode()
        packed = self._data[begin + _U64.size : stop]
        data = _decompressed(compression, packed, size)
        if len(data) != size or (crc and zlib.crc32(data) != crc):
            raise Damaged("a chunk whose checksum is wrong")
        return data

    def _take_part_of_chunk(self, start: int) -> None:
        """What can be decompressed of the chunk that the end of the file cuts."""
        try:
            *_, length = _CHUNK.unpack_from(self._data, start)
            begin = start + _CHUNK.size + length
            compression = bytes(self._data[begin - length : begin]).decode()
            self._take_records(_decompressed_part(compression, self._data[begin + _U64.size :]))
        except (Damaged, struct.error, UnicodeDecodeError, zstandard.ZstdError, RuntimeError):
            return  # its end is told all the same, and nothing of it counts as read

    def _take_schema(self, record: memoryview) -> None:
        (number,) = _U16.unpack_from(record)
        if number in self._schemas:
            return  # the summary repeats it, and only one of them may be damaged
        name, position = _string(record, _U16.size)
        encoding, position = _string(record, position)
        (length,) = _U32.unpack_from(record, position)
        self._schemas[number] = name
        if encoding == "ros2msg":
            begin = position + _U32.size
            self._contents.definitions[name] = bytes(record[begin : begin + length]).decode()

    def _take_channel(self, record: memoryview) -> None:
        number, schema = _U16.unpack_from(record)[0], _U16.unpack_from(record, 2)[0]
        if number in self._channels:
            return
        topic, _ = _string(record, 4)
        type_name = self._schemas.get(schema, "")
        self._channels[number] = topic, type_name, self._contents.wanted(topic, type_name)
        self._contents.add_topic(topic, type_name)

    def _indexed_chunks(self) -> list[int]:
        """Offsets of all chunks by the summary at the end of the file; empty without one."""
        data, tail = self._data, len(MAGIC) + _FOOTER.size
        if len(data) < 2 * len(MAGIC) + _RECORD.size + _FOOTER.size or bytes(data[-len(MAGIC) :]) != MAGIC:
            return []
        summary = _FOOTER.unpack_from(data, len(data) - tail)[0]
        records = _records(data, summary) if summary else iter(())
        return [
            _U64.unpack_from(data, start + 16)[0]  # after the first and the last time
            for _, opcode, start, stop in records
            if opcode == CHUNK_INDEX and stop <= len(data)
        ]

    def _complain(self, text: str) -> None:
        self._contents.problems.append(f"{self._name}: {text}")

    def _complain_damage(self, at: int, what: str) -> None:
        read = f"{self._contents.read} messages before that were read"
        self._complain(f"damaged near byte {at} of {len(self._data)}: {what}; {read}")

    def _complain_early_end(self) -> None:
        read = f"{self._contents.read} messages before that were read"
        size = f"{len(self._data)} bytes"
        self._complain(
            f"the file ends early, after {size} and without its footer: its writer was killed; {read}"
        )


def _records(data: memoryview, position: int) -> Iterator[tuple[int, int, int, int]]:
    """Offset, opcode, and start and stop of the content of each record; the stop may lie past the end."""
    while position + _RECORD.size <= len(data):
        opcode, length = _RECORD.unpack_from(data, position)
        start = position + _RECORD.size
        yield position, opcode, start, start + length
        position = start + length


def _string(record: memoryview, position: int) -> tuple[str, int]:
    """A string and the position after it."""
    (length,) = _U32.unpack_from(record, position)
    begin = position + _U32.size
    return bytes(record[begin : begin + length]).decode(), begin + length


def _decompressed(compression: str, packed: memoryview, size: int) -> bytes:
    if compression == "zstd":
        return zstandard.decompress(packed, size)
    if compression == "lz4":
        return bytes(lz4.frame.decompress(packed))
    if compression == "":
        return bytes(packed)
    raise Damaged(f"a chunk compressed by '{compression}', which is neither zstd nor lz4")


def _decompressed_part(compression: str, packed: memoryview) -> bytes:
    """As much as these bytes, the first ones of a compressed chunk, give."""
    if compression == "zstd":
        return zstandard.ZstdDecompressor().decompressobj().decompress(packed)
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed))
    return _decompressed(compression, packed, 0)
