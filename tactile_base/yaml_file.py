"""YAML files whose errors name file, line and valid choices.

A file is read into sections (mappings) that know where they stand, and are asked for what they should hold::

    root = read_yaml("scene.yaml")
    root.allow("arms", "surfaces")
    for name, arm in root.sections("arms").items():
        rate = arm.number("rate", default=120.0)
        limits = arm.settings("limits", ArmLimits)
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import yaml

from tactile_base.input_file import read_text
from tactile_base.settings import SettingError, SettingGroups, Settings, shown, unknown_name

S = TypeVar("S", bound=Settings)
_MISSING: Any = object()
# what everybody takes for a number, and YAML 1.1 for a text: 1e-3, 2E5
_EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$")
_TAG = "tag:yaml.org,2002:"
_SCALARS = tuple(_TAG + name for name in ("null", "bool", "int", "float"))
_OTHERS = tuple(_TAG + name for name in ("str", "seq", "map"))
# far more than any file or message has that people write, and little enough to be read at once
_LONGEST_FILE, _LONGEST_TEXT, _LONGEST_NUMBER = 200_000, 20_000, 40
_MOST_VALUES, _DEEPEST = 20_000, 50
#: In the description of a ROS parameter, before the value with which its node was started.
STARTED_WITH = "; started with "
_TOO_DEEP = f"nested more than {_DEEPEST} deep"


class Section:
    """One mapping of a YAML file.

    Attributes
    ----------
    path : the file
    line : line of the mapping, from 1
    name : how messages call it ("arms.left"); empty for the whole file
    values : its content; mappings in it are sections too
    """

    def __init__(self, path: Path, line: int, values: dict[str, Any], lines: dict[str, int]) -> None:
        self.path, self.line, self.values, self._lines = path, line, values, lines
        self.name = ""
        self.error: type[SettingError] = SettingError

    def with_values(self, values: dict[str, Any]) -> Section:
        """A copy with other content, whose errors are reported at the section's first line."""
        section = Section(self.path, self.line, values, {})
        section.name, section.error = self.name, self.error
        return section

    def where(self, key: str | None = None) -> str:
        """File and line of the section, or of one of its keys."""
        return f"{self.path}:{self._lines.get(key, self.line) if key is not None else self.line}"

    def fail(self, message: str, key: str | None = None) -> NoReturn:
        """Raise the file's error type with file and line in front of the message."""
        raise self.error(f"{self.where(key)}: {message}")

    def allow(self, *keys: str) -> None:
        """Refuse keys that are not among these."""
        for key in self.values:
            if key not in keys:
                self.fail((f"{self.name}: " if self.name else "") + unknown_name(key, keys), key)

    def value(self, key: str, default: Any = _MISSING) -> Any:
        """The value as it stands; refused if it is missing and no default is given."""
        if key in self.values:
            return self.values[key]
        if default is _MISSING:
            self.fail(f"{self._called(key)} is missing")
        return default

    def text(self, key: str, default: Any = _MISSING) -> str:
        """A string."""
        value = self.value(key, default)
        if not isinstance(value, str):
            self.fail(f"{self._called(key)} = {shown(value)}: must be a text", key)
        return value

    def choice(self, key: str, choices: list[str] | tuple[str, ...], default: Any = _MISSING) -> str:
        """One of some names."""
        value = self.text(key, default)
        if value not in choices:
            self.fail(f"{self._called(key)}: {unknown_name(value, choices)}", key)
        return value

    def number(self, key: str, default: Any = _MISSING) -> float:
        """A finite number."""
        value = self.value(key, default)
        if not _is_number(value):
            self.fail(f"{self._called(key)} = {shown(value)}: must be a finite number", key)
        return float(value)

    def numbers(self, key: str, length: int, default: Any = _MISSING) -> tuple[float, ...]:
        """A list of finite numbers."""
        value = self.value(key, default)
        if not isinstance(value, list | tuple) or len(value) != length or not all(map(_is_number, value)):
            self.fail(f"{self._called(key)} = {shown(value)}: must be a list of {length} finite numbers", key)
        return tuple(float(element) for element in value)

    def names(self, key: str, choices: list[str], default: Any = _MISSING) -> tuple[str, ...]:
        """A list of names, each among the choices."""
        value = self.value(key, default)
        if not isinstance(value, list | tuple):
            self.fail(f"{self._called(key)} = {shown(value)}: must be a list of names", key)
        for name in value:
            if name not in choices:
                self.fail(f"{self._called(key)}: {unknown_name(str(name), choices)}", key)
        return tuple(value)

    def section(self, key: str) -> Section:
        """A mapping, empty where the key is missing or has no value."""
        value = self.values.get(key)
        if value is None:
            value = Section(self.path, self._lines.get(key, self.line), {}, {})
        if not isinstance(value, Section):
            self.fail(f"{self._called(key)} = {shown(value)}: must hold names and values", key)
        value.name, value.error = self._called(key), self.error
        return value

    def sections(self, key: str) -> dict[str, Section]:
        """A mapping whose values are mappings."""
        outer = self.section(key)
        return {name: outer.section(name) for name in outer.values}

    def settings(self, key: str, cls: type[S]) -> S:
        """A mapping as settings; what is missing has its default."""
        section = self.section(key)
        return section.checked(cls, section.values)

    def checked(self, cls: type[S], values: Mapping[str, Any]) -> S:
        """Settings from some of the section's values; what is missing has its default."""
        try:
            return cls.from_mapping(values)
        except SettingError as error:
            self.fail((f"{self.name}: " if self.name else "") + str(error), _culprit(cls, values))

    def _called(self, key: str) -> str:
        return f"{self.name}.{key}" if self.name else key

    def __repr__(self) -> str:
        return repr(self.values)


def read_yaml(path: str | Path, error: type[SettingError] = SettingError) -> Section:
    """The file as a section; what is wrong in it is raised as `error`.

    Raises `OSError` where the file cannot be read.
    """
    path = Path(path)
    try:
        root = _load(read_text(path), _section_loader(path), _LONGEST_FILE)
    except yaml.MarkedYAMLError as problem:
        mark = problem.problem_mark
        raise error(f"{path}:{mark.line + 1 if mark else 1}: not valid YAML: {problem.problem}") from problem
    except (yaml.YAMLError, UnicodeDecodeError) as problem:
        raise error(f"{path}: not valid YAML: {problem}") from problem
    if not isinstance(root, Section):
        raise error(f"{path}:1: must hold names and values, holds {shown(root)}")
    root.error = error
    return root


def _load(text: str, loader: type[_Loader] | None = None, longest: int = _LONGEST_TEXT) -> Any:
    """The value of a text; `yaml.YAMLError` whatever is wrong with it."""
    if len(text) > longest:
        raise yaml.YAMLError(f"has {len(text)} characters, must have no more than {longest}")
    return yaml.load(text, Loader=loader or _Loader)


class _Loader(yaml.SafeLoader):
    """Makes plain values: texts, numbers, truth values, lists and mappings of a size that people write."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """The next value of the document; its parts come through here, too."""
        self.depth += 1
        if self.depth > _DEEPEST:
            raise yaml.constructor.ConstructorError(None, None, _TOO_DEEP, self.peek_event().start_mark)
        node: yaml.Node | None = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def get_single_node(self) -> yaml.Node | None:
        """The document, before values are made of it."""
        root: yaml.Node | None = super().get_single_node()
        if root is not None:
            _measure(root, {})
        return root


def _plain_scalar(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> Any:
    try:
        if len(node.value) <= _LONGEST_NUMBER:
            return yaml.SafeLoader.yaml_constructors[node.tag](loader, node)
    except (ValueError, KeyError, IndexError):
        pass
    problem = f"{shown(node.value)} cannot be read as {node.tag.rpartition(':')[2]}"
    raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


_Loader.yaml_constructors = {
    tag: _plain_scalar if tag in _SCALARS else make
    for tag, make in yaml.SafeLoader.yaml_constructors.items()
    if tag is None or tag in _SCALARS or tag in _OTHERS
}
_Loader.yaml_implicit_resolvers = {
    first: [(tag, expression) for tag, expression in found if tag != _TAG + "timestamp"]
    for first, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(_TAG + "float", _EXPONENT, list("+-0123456789."))


def _measure(node: yaml.Node, known: dict[int, tuple[int, int] | None]) -> tuple[int, int]:
    """Values in a node and its depth, with what its aliases repeat; refuses too many of either."""
    if id(node) not in known:
        known[id(node)] = None  # as long as it is under way
        children = node.value if isinstance(node, yaml.CollectionNode) else []
        parts = [part for child in children for part in (child if isinstance(child, tuple) else (child,))]
        sizes = [_measure(part, known) for part in parts]
        known[id(node)] = (
            1 + sum(size for size, _ in sizes),
            1 + max((deep for _, deep in sizes), default=0),
        )
    measured = known[id(node)]
    problem = ""
    if measured is None:
        problem = "an alias repeats what it stands in"
    elif measured[1] > _DEEPEST:
        problem = _TOO_DEEP
    elif measured[0] > _MOST_VALUES:
        problem = f"has more than {_MOST_VALUES} values, counting those that aliases repeat"
    if measured is None or problem:
        raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)
    return measured


def _section_loader(path: Path) -> type[_Loader]:
    """A loader that makes mappings into sections and refuses a name given twice."""

    class Loader(_Loader):
        pass

    def construct(loader: yaml.SafeLoader, node: yaml.MappingNode) -> Section:
        loader.flatten_mapping(node)
        values: dict[str, Any] = {}
        lines: dict[str, int] = {}
        for key_node, value_node in node.value:
            key = str(loader.construct_object(key_node, deep=True))
            if key in values:
                problem = f"'{key}' is given twice, first in line {lines[key]}"
                raise yaml.constructor.ConstructorError(None, None, problem, key_node.start_mark)
            values[key] = loader.construct_object(value_node, deep=True)
            lines[key] = key_node.start_mark.line + 1
        return Section(path, node.start_mark.line + 1, values, lines)

    Loader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, construct)
    return Loader


def _culprit(cls: type[Settings], values: Mapping[str, Any]) -> str | None:
    """The first name whose value is refused even alone; None where only the combination is."""
    for name, value in values.items():
        try:
            cls.from_mapping({name: value})
        except SettingError:
            return name
    return None


def _is_number(value: Any) -> bool:
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    return plain and abs(value) < float("inf")


def text_of(settings: Settings | SettingGroups | Mapping[str, Any]) -> str:
    """Names and values on one line of YAML, as messages and bags carry them: `{length: 0.1, target: []}`."""
    values = settings if isinstance(settings, Mapping) else dataclasses.asdict(settings)
    return yaml.safe_dump(
        _plain(values), default_flow_style=True, sort_keys=False, width=math.inf, allow_unicode=True
    ).strip()


def value_text(value: Any) -> str:
    """One value as YAML in one line, as people type it: `[0.0, 3.0]`."""
    text = yaml.safe_dump(_plain(value), default_flow_style=True, width=math.inf, allow_unicode=True)
    return text.removesuffix("\n...\n").strip()


def typed_value(text: str, what: str) -> Any:
    """The value that somebody typed, read as YAML; a `SettingError` begins with `what`."""
    try:
        return _load(text)
    except yaml.YAMLError as error:
        raise SettingError(f"{what}: not valid YAML: {' '.join(str(error).split())}") from error


def values_of(text: str, what: str) -> dict[str, Any]:
    """The names and values that `text_of` wrote, or that somebody typed; an empty text holds none.

    Raises `SettingError` if it is not a mapping in YAML; the message begins with `what`.
    """
    values = typed_value(text, what)
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise SettingError(f"{what} = {shown(values)}: must hold names and values, as {{length: 0.1}}")
    return {str(name): value for name, value in values.items()}


def _plain(value: Any) -> Any:
    """What YAML has types for."""
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    value = value.tolist() if hasattr(value, "tolist") else value
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def name_and_value(change: str, example: str) -> tuple[str, Any]:
    """Split NAME=VALUE; the value is read as YAML.

    Raises `SettingError` if there is no "=", or the value is no YAML.
    """
    name, equals, text = change.partition("=")
    if not equals:
        raise SettingError(f"--set {change}: must have the form NAME=VALUE, as {example}")
    return name, typed_value(text, f"--set {change}")
