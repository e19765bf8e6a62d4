"""Decompression within limits: a bag of 2 MB must not fill the memory because it says that it holds 6 GB."""

from __future__ import annotations

from pathlib import Path
from typing import IO

import lz4.frame
import zstandard

ALLOWED, TIMES_FILE = 100_000_000, 40  # bytes that any file may take in memory, and more for each of its own
MESSAGE_COST = 250  # bytes that a message takes in memory beside its data
BLOCK = 1 << 20
_WINDOW = 1 << 27  # what zstd writes at most without `--long`
_LZ4_RATIO = 255  # lz4 compresses to no less than this part


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

    def unpack(self, data: bytes, compression: str = "zstd", part: bool = False) -> bytes:
        """One frame, whole; or `part` of one, whose end is missing.

        Raises `TooLarge`; `ZstdError`, `RuntimeError` or `ValueError` for a damaged one.
        """
        if compression == "zstd":
            data = self._zstd_frame(data, part)
        elif compression == "lz4":
            most = min(self.left, _LZ4_RATIO * len(data))
            data = bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most + 1))
        elif compression:
            raise ValueError(f"compression '{compression}' is not known")
        self.take(len(data))
        return data

    def _zstd_frame(self, data: bytes, part: bool) -> bytes:
        size = zstandard.frame_content_size(data)
        if size < 0 or part:  # not known
            with self._zstd.stream_reader(data) as stream:
                return bytes(stream.read(self.left + 1))
        if size > self.left:
            self.take(size)
        return self._zstd.decompress(data, max_output_size=max(size, 1))

    def file(self, packed: IO[bytes], target: Path) -> None:
        """A file that is compressed as a whole, as far as it goes; raises `ZstdError` and `TooLarge`."""
        with target.open("wb") as out, self._zstd.stream_reader(packed, read_across_frames=True) as stream:
            while block := stream.read(BLOCK):
                self.take(len(block))
                out.write(block)
