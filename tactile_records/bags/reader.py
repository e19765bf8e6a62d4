"""Reads bags message by message: MCAP and sqlite3, compressed or not, ours and those of `ros2 bag`.

What is readable of a truncated or damaged bag is read, and the rest is named.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml
import zstandard

from tactile_records.bags.contents import Bag, BagError, Recorded, Wanted
from tactile_records.bags.mcap import McapReader
from tactile_records.bags.sqlite import read_sqlite
from tactile_records.bags.writer import METADATA

__all__ = ["Bag", "BagError", "Recorded", "read_bag"]

SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")


def read_bag(folder: Path, wanted: Wanted | None = None) -> Bag:
    """Read a bag, also one whose writer was killed.

    Parameters
    ----------
    folder : Path
        The bag's folder, or one of its files alone.
    wanted : callable, optional
        Of topic and type: whether messages are kept; by default all are.

    Raises
    ------
    BagError
        There is no bag at that place, or nothing in it can be read.
    """
    bag = Bag(folder.parent if folder.is_file() else folder)
    bag.wanted = wanted or bag.wanted
    information = _read_metadata(folder, bag.problems)
    files = _files(folder, information, bag.problems)
    unpack = _message_unpacker(information)
    readable = [_read_file(file, bag, unpack) for file in files]
    if not any(readable):
        raise BagError(f"{folder}: nothing in it can be read ({bag.problem})")
    bag.note = {str(key): str(value) for key, value in (information.get("custom_data") or {}).items()}
    return bag


def _read_file(file: Path, bag: Bag, unpack: Callable[[bytes], bytes]) -> bool:
    """Read one file of a bag into `bag`; False if it holds nothing readable."""
    first = len(bag.messages)
    if file.suffix == ".zstd":
        with TemporaryDirectory(prefix="tactile_bag_") as folder:
            return _read_file(_unpacked_file(file, Path(folder), bag.problems), bag, unpack)
    if file.suffix == ".db3":
        return read_sqlite(file, bag, unpack)
    with file.open("rb") as stream:
        if not file.stat().st_size:
            bag.problems.append(f"{file.name}: is empty")
            return False
        data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        readable = McapReader(data, file.name, bag).read()
    if unpack is not bytes:
        bag.messages[first:] = [m._replace(data=unpack(m.data)) for m in bag.messages[first:]]
    return readable


def _unpacked_file(file: Path, folder: Path, problems: list[str]) -> Path:
    """A file that `ros2 bag` compressed as a whole, decompressed as far as it goes."""
    target = folder / file.stem
    with file.open("rb") as packed, target.open("wb") as stream:
        decompressor = zstandard.ZstdDecompressor().decompressobj(read_across_frames=True)
        try:
            while block := packed.read(1 << 20):
                stream.write(decompressor.decompress(block))
        except zstandard.ZstdError as error:
            problems.append(f"{file.name}: damaged before byte {packed.tell()}: {error}")
    return target


def _message_unpacker(information: dict[str, Any]) -> Callable[[bytes], bytes]:
    """What decompresses single messages, where the bag was recorded so."""
    mode, form = (str(information.get(f"compression_{what}") or "") for what in ("mode", "format"))
    if form not in ("", "zstd"):
        raise BagError(f"compression_format '{form}' of {METADATA}: only zstd is known")
    return zstandard.ZstdDecompressor().decompress if mode.upper() == "MESSAGE" else bytes


def _files(folder: Path, information: dict[str, Any], problems: list[str]) -> list[Path]:
    """The files of a bag in their order."""
    if folder.is_file():
        return [folder]
    if not folder.is_dir():
        raise BagError(f"{folder}: no such bag")
    found = [path for path in folder.iterdir() if path.name.endswith(SUFFIXES) and path.is_file()]
    named = [folder / Path(name).name for name in information.get("relative_file_paths") or []]
    for path in named:
        if path not in found:
            problems.append(f"{path.name}: the file is missing, {METADATA} names it")
    # files that the metadata does not name yet: the recorder was killed
    others = sorted(set(found) - set(named), key=_numbers_last)
    files = [path for path in named if path in found] + others
    if not files:
        raise BagError(f"{folder}: holds 0 .mcap files, must hold one (or .db3; or either with .zstd)")
    return files


def _numbers_last(path: Path) -> tuple[str, int]:
    """bag_2.mcap comes before bag_10.mcap."""
    match = re.match(r"(.*?)_?(\d*)\.[^_\d]", path.name)
    return (match[1], int(match[2] or -1)) if match else (path.name, -1)


def _read_metadata(folder: Path, problems: list[str]) -> dict[str, Any]:
    """What metadata.yaml says; empty without one, as after a kill of `ros2 bag record`."""
    file = (folder.parent if folder.is_file() else folder) / METADATA
    if not file.is_file():
        return {}
    loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the one in C is not everywhere
    try:
        return dict(yaml.load(file.read_text(), Loader=loader)["rosbag2_bagfile_information"])
    except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        problems.append(f"{file.name}: cannot be understood and was passed over: {error}")
        return {}
