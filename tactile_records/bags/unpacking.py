"""Decompression within limits: a bag of 2 MB must not fill the memory because it says that it holds 6 GB."""

from __future__ import annotations

from pathlib import Path
from typing import IO, Any

import lz4.frame
import zstandard

ALLOWED, TIMES_FILE = (
    100_000_000,
    40,
)  # bytes that any file may take in memory, and more for each of its bytes
MESSAGE_COST = 250  # bytes that a message takes in memory beside its data
BLOCK = 1 << 20
_WINDOW = 1 << 27  # what zstd writes at most without `--long`
_LZ4_RATIO = 255  # lz4 compresses to no less than this part

Data = bytes | memoryview


class TooLarge(ValueError):
    """What a file holds takes more memory than it may."""


class Unpacker:
    """Decompresses what one file holds, and counts what that takes.

    Parameters
    ----------
    size : int
        Of the file, bytes.
    """

    def __init__(self, size: int) -> None:
        self.allowed = self.left = ALLOWED + TIMES_FILE * size
        self._zstd = zstandard.ZstdDecompressor(max_window_size=_WINDOW)

    def take(self, count: int) -> None:
        """Count bytes that are kept; raises `TooLarge`."""
        self.left -= count
        if self.left < 0:
            raise TooLarge(
                f"holds more than {self.allowed / 1e6:.0f} MB, {TIMES_FILE} times its size and "
                f"{ALLOWED / 1e6:.0f} MB; the rest was not read"
            )

    def zstd(self, data: Data, announced: int | None = None) -> bytes:
        """One frame, whole; raises `ZstdError` for a damaged one and `TooLarge`.

        Parameters
        ----------
        announced : int, optional
            Size by what stands around it. A frame that says to be too large and not that is damaged.
        """
        size = zstandard.frame_content_size(data)
        if size > self.left:
            if announced not in (None, size):
                raise zstandard.ZstdError(f"says to hold {size} bytes, {announced} are expected")
            self.take(size)
        if size < 0:  # not known
            with self._zstd.stream_reader(data) as stream:
                unpacked = stream.read(self.left + 1)
        else:
            unpacked = self._zstd.decompress(data, max_output_size=max(size, 1))
        self.take(len(unpacked))
        return unpacked

    def lz4(self, data: Data) -> bytes:
        """One frame; raises `RuntimeError` for a damaged one and `TooLarge`."""
        most = min(self.left, _LZ4_RATIO * len(data))
        unpacked = bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most + 1))
        self.take(len(unpacked))
        return unpacked

    def part(self, data: Data, compression: str) -> bytes:
        """What can be decompressed of data whose end is missing."""
        if compression == "zstd":
            stream: Any = self._zstd.stream_reader(data)
            unpacked = b"".join(_blocks(stream, self.left))
        elif compression == "lz4":
            return self.lz4(data)
        else:
            unpacked = bytes(data)
        self.take(len(unpacked))
        return unpacked

    def file(self, packed: IO[bytes], target: Path) -> None:
        """A file that is compressed as a whole, as far as it goes; raises `ZstdError` and `TooLarge`."""
        with target.open("wb") as out, self._zstd.stream_reader(packed, read_across_frames=True) as stream:
            while block := stream.read(BLOCK):
                self.take(len(block))
                out.write(block)


def _blocks(stream: IO[bytes], most: int) -> list[bytes]:
    """What can be read, block by block, until the first damage."""
    blocks: list[bytes] = []
    try:
        while most >= 0 and (block := stream.read(BLOCK)):
            blocks.append(block)
            most -= len(block)
    except zstandard.ZstdError:
        pass
    return blocks
