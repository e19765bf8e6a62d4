"""Reads bags message by message: MCAP and sqlite3, compressed or not, ours and those of `ros2 bag`.

What is readable of a truncated or damaged bag is read, and the rest is named.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml
import zstandard
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tactile_records.bags.contents import BagError, Contents, Recorded, Wanted
from tactile_records.bags.mcap import McapReader
from tactile_records.bags.sqlite import read_sqlite
from tactile_records.bags.writer import METADATA

__all__ = ["Bag", "BagError", "Recorded", "read_bag"]

SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")


@dataclass
class Bag:
    """What could be read of a bag.

    Attributes
    ----------
    folder : Path
        The bag.
    complete : bool
        False where a file is missing, ends early or holds damaged data.
    problem : str
        What is missing and why; empty for a complete bag.
    messages : list of Recorded
        In the order of the files.
    note : dict
        What the writer was given to keep with the bag.
    definitions : dict
        Type -> text of its definition, of the types that the bag defines.
    types : dict
        Topic -> type, also of topics without messages.
    counts : dict
        Topic -> number of messages, also of those that `read_bag` was not asked for.
    """

    folder: Path
    complete: bool = True
    problem: str = ""
    messages: list[Recorded] = field(default_factory=list)
    note: dict[str, str] = field(default_factory=dict)
    definitions: dict[str, str] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)

    def decoded(self, topic: str) -> Iterator[tuple[Recorded, Any]]:
        """The messages of one topic, deserialised by the definitions in the bag."""
        store = self.typestore()
        for message in self.messages:
            if message.topic == topic:
                yield message, store.deserialize_cdr(message.data, message.type)

    @property
    def topics(self) -> dict[str, int]:
        """Topic -> number of messages, of the topics that have any."""
        return {topic: count for topic, count in self.counts.items() if count}

    def typestore(self) -> Any:
        """The types that the bag defines, for `rosbags`."""
        if not hasattr(self, "_store"):
            store = get_typestore(Stores.EMPTY)
            for name, text in self.definitions.items():
                types = get_types_from_msg(text, name)
                store.register({key: value for key, value in types.items() if key not in store.types})
            self._store = store
        return self._store


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
    contents = Contents() if wanted is None else Contents(wanted)
    information = _read_metadata(folder, contents.problems)
    files = _files(folder, information, contents.problems)
    unpack = _message_unpacker(information)
    readable = [_read_file(file, contents, unpack) for file in files]
    problem = "; ".join(contents.problems)
    if not any(readable):
        raise BagError(f"{folder}: nothing in it can be read ({problem})")
    bag = Bag(folder.parent if folder.is_file() else folder, not contents.problems, problem)
    bag.note = {str(key): str(value) for key, value in (information.get("custom_data") or {}).items()}
    bag.messages, bag.definitions = contents.messages, contents.definitions
    bag.types, bag.counts = contents.types, contents.counts
    return bag


def _read_file(file: Path, contents: Contents, unpack: Callable[[bytes], bytes]) -> bool:
    """Read one file of a bag into `contents`; False if it holds nothing readable."""
    first = len(contents.messages)
    if file.suffix == ".zstd":
        with TemporaryDirectory(prefix="tactile_bag_") as folder:
            return _read_file(_unpacked_file(file, Path(folder), contents.problems), contents, unpack)
    if file.suffix == ".db3":
        return read_sqlite(file, contents, unpack)
    with file.open("rb") as stream:
        if not file.stat().st_size:
            contents.problems.append(f"{file.name}: is empty")
            return False
        data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        readable = McapReader(data, file.name, contents).read()
    if unpack is not bytes:
        contents.messages[first:] = [m._replace(data=unpack(m.data)) for m in contents.messages[first:]]
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
