"""The .msg texts of message types with all that they use: with them a bag is read without their packages."""

from __future__ import annotations

import functools
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

_SEPARATOR = "=" * 80
_FIELD_TYPE = re.compile(r"^\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+\w+")
_INTEGERS = (f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))
_PRIMITIVES = frozenset(["bool", "byte", "char", "float32", "float64", "string", "wstring", *_INTEGERS])


class DefinitionMissing(ValueError):
    """A message type whose .msg file is not installed; the message says where it was looked for."""


def message_definition(type_name: str) -> str:
    """The .msg text of a type with all types that it uses, as MCAP wants it (`ros2msg`).

    Read from `share/<package>/msg` under the prefixes of AMENT_PREFIX_PATH, then that of the Python
    environment; what is nowhere there comes from our source tree and from the common packages that `rosbags`
    brings. Raises `DefinitionMissing` where a file is missing.
    """
    texts: dict[str, str] = {}
    _collect_definitions(type_name, texts)
    first, *others = texts.items()
    parts = [first[1]] + [f"{_SEPARATOR}\nMSG: {_short(name)}\n{text}" for name, text in others]
    return "\n".join(parts)


def _collect_definitions(type_name: str, texts: dict[str, str]) -> None:
    if type_name in texts:
        return
    texts[type_name] = _read_definition(type_name)
    package = type_name.split("/")[0]
    for line in texts[type_name].splitlines():
        match = _FIELD_TYPE.match(line.split("#")[0])
        if match and match[1] not in _PRIMITIVES:
            _collect_definitions(_full(match[1], package), texts)


def _read_definition(type_name: str) -> str:
    package, _, name = type_name.split("/")
    prefixes = [prefix for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    prefixes.append(sys.prefix)
    files = [Path(prefix) / "share" / package / "msg" / f"{name}.msg" for prefix in prefixes]
    for path in (*files, Path(__file__).parents[2] / package / "msg" / f"{name}.msg"):
        if path.is_file():
            return path.read_text()
    known = _known_definition(type_name)
    if known:
        return known
    raise DefinitionMissing(
        f"no definition of {type_name}: share/{package}/msg/{name}.msg is under none of {', '.join(prefixes)}"
    )


def _known_definition(type_name: str) -> str:
    """The text of a type, without those that it uses, of those that `rosbags` knows; empty for others."""
    store = get_typestore(Stores.LATEST)
    if type_name not in store.fielddefs:
        return ""
    return str(store.generate_msgdef(type_name, ros_version=2)[0].split(_SEPARATOR)[0])


def _full(name: str, package: str) -> str:
    """`Header`, `std_msgs/Header` or `std_msgs/msg/Header` as `std_msgs/msg/Header`."""
    parts = name.split("/")
    return f"{parts[0] if len(parts) > 1 else package}/msg/{parts[-1]}"


def _short(name: str) -> str:
    return name.replace("/msg/", "/")


def type_hash(type_name: str, text: str) -> str:
    """The RIHS01 hash of a type, from its whole definition."""
    return str(_typestore(type_name, text).hash_rihs01(type_name))


def type_fields(definitions: Mapping[str, str], type_name: str) -> Any:
    """Type -> (constants, fields) of a type and all that it uses, as `rosbags` has them.

    Parameters
    ----------
    definitions : mapping
        Type -> definition, as a bag brings them; for a type that is not there, or whose definition is
        damaged, the installed one is taken.
    """
    text = definitions.get(type_name)
    if text:
        try:
            return _typestore(type_name, text).fielddefs
        except TypesysError:
            pass
    return _typestore(type_name, message_definition(type_name)).fielddefs


@functools.lru_cache(maxsize=64)
def _typestore(type_name: str, text: str) -> Any:
    """The types of a definition; to understand one takes milliseconds."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, type_name))
    return store
