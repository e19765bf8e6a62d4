"""Reads bags message by message: MCAP and sqlite3, compressed or not, ours and those of `ros2 bag`.

What is readable of a truncated or damaged bag is read, and the rest is named.
"""

from __future__ import annotations

import mmap
import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml
import zstandard

from tactile_records.bags.contents import Bag, BagError, Recorded, Wanted
from tactile_records.bags.mcap import McapReader
from tactile_records.bags.sqlite import read_sqlite
from tactile_records.bags.unpacking import TooLarge, Unpacker
from tactile_records.bags.writer import METADATA

__all__ = ["Bag", "BagError", "Recorded", "read_bag"]

_YAML_DEPTH = 50
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
    information = read_metadata(folder, bag.problems)
    files = files_of(folder, information, bag.problems)
    packed = packed_messages(information)
    readable = [read_file(file, bag, packed, Unpacker(file.stat().st_size)) for file in files]
    if not any(readable):
        raise BagError(f"{folder}: nothing in it can be read ({bag.problem})")
    bag.note = {str(key): str(value) for key, value in information["custom_data"].items()}
    if not bag.problems and folder.is_dir():
        _compare(bag, information)
    return bag


def read_file(file: Path, bag: Bag, packed: bool, unpacker: Unpacker) -> bool:
    """Read one file into `bag`, its messages compressed or not; False if it holds nothing readable."""
    first = len(bag.messages)
    if file.suffix == ".zstd":
        with TemporaryDirectory(prefix="tactile_bag_") as folder:
            target = Path(folder) / file.stem
            unpack_file(file, target, bag.problems, unpacker)
            return read_file(target, bag, packed, unpacker)
    if file.suffix == ".db3":
        readable = read_sqlite(file, bag, unpacker)
    elif not file.stat().st_size:
        bag.problems.append(f"{file.name}: is empty")
        return False
    else:
        with file.open("rb") as stream:
            data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        readable = McapReader(data, file.name, bag, unpacker).read()
    if packed:
        _unpack_messages(file.name, bag, first, unpacker)
    return readable


def unpack_file(file: Path, target: Path, problems: list[str], unpacker: Unpacker) -> None:
    """Decompress a file that `ros2 bag` compressed as a whole, as far as it goes."""
    with file.open("rb") as packed:
        try:
            unpacker.file(packed, target)
        except TooLarge as error:
            problems.append(f"{file.name}: {error}")
        except zstandard.ZstdError as error:
            problems.append(f"{file.name}: damaged before byte {packed.tell()}: {error}")


def _unpack_messages(name: str, bag: Bag, first: int, unpacker: Unpacker) -> None:
    """Decompress the messages from the first on, which were compressed one by one."""
    packed, damaged = bag.messages[first:], []
    del bag.messages[first:]
    for message in packed:
        try:
            bag.messages.append(message._replace(data=unpacker.unpack(message.data)))
        except TooLarge as error:
            bag.problems.append(f"{name}: {error}")
            break
        except zstandard.ZstdError as error:
            damaged.append(f"{message.topic} at {message.received_ns} ns: {error}")
    if damaged:
        bag.problems.append(f"{name}: {len(damaged)} messages are damaged, the first: {damaged[0]}")


def packed_messages(information: dict[str, Any]) -> bool:
    """Whether the messages were compressed one by one."""
    mode, form = (str(information.get(f"compression_{what}") or "") for what in ("mode", "format"))
    if form not in ("", "zstd"):
        raise BagError(f"compression_format '{form}' of {METADATA}: only zstd is known")
    return mode.upper() == "MESSAGE"


def _compare(bag: Bag, information: dict[str, Any]) -> None:
    """Damage that nothing else has shown."""
    missing = [
        f"{bag.counts.get(topic, 0)} of {count} on {topic}"
        for topic, count in information["counts"].items()
        if bag.counts.get(topic, 0) < count
    ]
    if missing:
        bag.problems.append(f"messages that were read, of those that {METADATA} names: {', '.join(missing)}")


def files_of(folder: Path, information: dict[str, Any], problems: list[str]) -> list[Path]:
    """The files of a bag in their order."""
    if folder.is_file():
        return [folder]
    if not folder.is_dir():
        raise BagError(f"{folder}: no such bag")
    found = [path for path in folder.iterdir() if path.name.endswith(SUFFIXES) and path.is_file()]
    named = [folder / Path(name).name for name in information["relative_file_paths"]]
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


def read_metadata(folder: Path, problems: list[str]) -> dict[str, Any]:
    """What metadata.yaml says; empty without one, as after a kill of `ros2 bag record`."""
    file = (folder.parent if folder.is_file() else folder) / METADATA
    if not file.is_file():
        return _checked({})
    loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the one in C is not everywhere
    try:
        text = file.read_text()
        _refuse_depth(text, loader)
        return _checked(yaml.load(text, Loader=loader)["rosbag2_bagfile_information"])
    except (yaml.YAMLError, LookupError, TypeError, ValueError) as error:
        problems.append(f"{file.name}: cannot be understood and was passed over: {error}")
        return _checked({})


def _refuse_depth(text: str, loader: Any) -> None:
    """Raise ValueError for YAML that is nested so deeply that libyaml would overflow the stack."""
    depth = 0
    for event in yaml.parse(text, Loader=loader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _YAML_DEPTH:
            raise ValueError(f"nested more than {_YAML_DEPTH} deep")


def _checked(information: Any) -> dict[str, Any]:
    """What is used of metadata.yaml; raises TypeError, ValueError or LookupError for anything else."""
    if not isinstance(information, dict):
        raise TypeError("rosbag2_bagfile_information must be a mapping")
    files, note = information.get("relative_file_paths") or [], information.get("custom_data") or {}
    if not isinstance(files, list) or not all(isinstance(name, str) for name in files):
        raise TypeError("relative_file_paths must be a list of texts")
    if not isinstance(note, dict) or any(isinstance(value, dict | list) for value in note.values()):
        raise TypeError("custom_data must be a mapping of texts")
    topics = information.get("topics_with_message_count") or []
    counts = {str(topic["topic_metadata"]["name"]): int(topic["message_count"]) for topic in topics}
    texts = {name: information.get(name) for name in ("compression_mode", "compression_format")}
    return {"relative_file_paths": files, "custom_data": note, "counts": counts, **texts}
