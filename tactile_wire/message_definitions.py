"""The .msg texts of message types with all that they use: with them a bag is read without their packages."""

from __future__ import annotations

import functools
import os
import re
import sys
from pathlib import Path
from typing import Any, NoReturn

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from tactile_wire.errors import DefinitionDamaged, DefinitionMissing

_SEPARATOR = "=" * 80
_TYPE_NAME = re.compile(r"(\w+)/(msg|action)/(\w+)")
_FIELD_TYPE = re.compile(r"^\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+\w+")
_INTEGERS = (f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))
_PRIMITIVES = frozenset(["bool", "byte", "char", "float32", "float64", "string", "wstring", *_INTEGERS])


_LONGEST, _DEEPEST, _LARGEST = 1 << 18, 32, 1 << 20  # characters, types within types, elements of fixed size


def message_definition(type_name: str) -> str:
    """The .msg text of a type with all types that it uses, as MCAP wants it (`ros2msg`).

    Read from `share/<package>/msg` under the prefixes of AMENT_PREFIX_PATH, then that of the Python
    environment; what is nowhere there comes from the copy that is installed with this package, from our
    source tree, and from the common packages that `rosbags` brings. Raises `DefinitionMissing` otherwise.
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
    match = _TYPE_NAME.fullmatch(type_name)
    if match is None:
        raise DefinitionMissing(f"'{type_name}' is no name of a type: must be like 'package/msg/Name'")
    package, kind, name = match.groups()
    if kind == "action":
        return _read_feedback(package, name)
    file = f"{package}/msg/{name}.msg"
    return _installed(file) or _known_definition(type_name) or _refuse(type_name, file)


def _read_feedback(package: str, name: str) -> str:
    """What an action publishes, and the feedback in it, which ends the action's file."""
    action, _, part = name.rpartition("_")
    if part == "FeedbackMessage":
        return f"unique_identifier_msgs/UUID goal_id\n{package}/action/{action}_Feedback feedback\n"
    file = f"{package}/action/{action}.action"
    parts = re.split(r"^---$", _installed(file), flags=re.MULTILINE)
    return parts[2] if part == "Feedback" and len(parts) == 3 else _refuse(f"{package}/action/{name}", file)


def _installed(file: str) -> str:
    """Text of a file below a share folder, or in our source tree; empty where it is nowhere."""
    folders = [prefix / "share" / part for part in ("", "tactile_servoing") for prefix in _prefixes()]
    for path in (folder / file for folder in [*folders, Path(__file__).parents[2]]):
        if path.is_file():
            return path.read_text()
    return ""


def _prefixes() -> list[Path]:
    found = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return [Path(prefix) for prefix in (*found, sys.prefix) if prefix]


def _refuse(type_name: str, file: str) -> NoReturn:
    places = ", ".join(map(str, _prefixes()))
    raise DefinitionMissing(f"no definition of {type_name}: share/{file} is under none of {places}")


def _known_definition(type_name: str) -> str:
    """The text of a type, without those that it uses, of those that `rosbags` knows; empty for others."""
    store = get_typestore(Stores.LATEST)
    if type_name not in store.fielddefs:
        return ""
    return str(store.generate_msgdef(type_name, ros_version=2)[0].split(_SEPARATOR)[0])


def _full(name: str, package: str) -> str:
    """`Header`, `std_msgs/Header` or `std_msgs/msg/Header` as `std_msgs/msg/Header`; actions alike."""
    parts = name.split("/")
    kind = "action" if parts[1:-1] == ["action"] else "msg"
    return f"{parts[0] if len(parts) > 1 else package}/{kind}/{parts[-1]}"


def _short(name: str) -> str:
    return name.replace("/msg/", "/")


def type_hash(type_name: str, text: str) -> str:
    """The RIHS01 hash of a type, from its whole definition."""
    return str(typestore(type_name, text).hash_rihs01(type_name))


def type_fields(type_name: str) -> Any:
    """Type -> (constants, fields) of an installed type and all that it uses, as `rosbags` has them."""
    return installed_typestore(type_name).fielddefs


@functools.lru_cache(maxsize=64)
def installed_typestore(type_name: str) -> Any:
    """`typestore` of a type as it is installed, whose files are read once: messages ask for it one by one."""
    return typestore(type_name, message_definition(type_name))


@functools.lru_cache(maxsize=64)
def typestore(type_name: str, text: str) -> Any:
    """The types of a definition, for `rosbags`; to understand one takes milliseconds.

    Raises `DefinitionDamaged` for a text that is no definition, or one of types that hold themselves.
    """
    if len(text) > _LONGEST:
        raise DefinitionDamaged(f"has {len(text)} characters, may have {_LONGEST}")
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(text, type_name))
    except (TypesysError, RecursionError, LookupError, TypeError, ValueError, AttributeError) as error:
        raise DefinitionDamaged("cannot be parsed") from error
    _size(store.fielddefs, type_name, {}, ())
    return store


def _size(fields: Any, type_name: str, known: dict[str, int], within: tuple[str, ...]) -> int:
    """Least number of elements of a type; raises `DefinitionDamaged` where there is no end to them."""
    if type_name in within or len(within) > _DEEPEST:
        raise DefinitionDamaged(f"{within[0]} holds itself, or types more than {_DEEPEST} deep")
    if type_name not in fields:
        raise DefinitionDamaged(f"{type_name} is not defined")
    if type_name not in known:
        known[type_name] = 1
        for _, (node, content) in fields[type_name][1]:
            count = content[1] if node == Nodetype.ARRAY else 1
            if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                node, content = content[0]
            inner = node == Nodetype.NAME
            known[type_name] += count * (_size(fields, content, known, (*within, type_name)) if inner else 1)
        if known[type_name] > _LARGEST:
            raise DefinitionDamaged(f"{type_name} has more than {_LARGEST} elements")
    return known[type_name]
