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

from tactile_base.settings import SettingError, SettingGroups, Settings, shown, unknown_name

S = TypeVar("S", bound=Settings)
_MISSING: Any = object()
# what everybody takes for a number, and YAML 1.1 for a text: 1e-3, 2E5
_EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+")


class Section:
    """One mapping of a YAML file.

    Attributes
    ----------
    path : Path
        The file.
    line : int
        Line of the mapping, from 1.
    name : str
        How messages call it ("arms.left"); empty for the whole file.
    values : dict
        Its content; mappings in it are sections too.
    """

    def __init__(self, path: Path, line: int, values: dict[str, Any], lines: dict[str, int]) -> None:
        self.path, self.line, self.values, self._lines = path, line, values, lines
        self.name = ""
        self.error: type[SettingError] = SettingError

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
    loader = _loader(path)
    try:
        # a safe loader: it makes plain values and sections only
        root = yaml.load(path.read_text(encoding="utf-8"), Loader=loader)
    except yaml.MarkedYAMLError as problem:
        mark = problem.problem_mark
        raise error(f"{path}:{mark.line + 1 if mark else 1}: not valid YAML: {problem.problem}") from problem
    except (yaml.YAMLError, UnicodeDecodeError) as problem:
        raise error(f"{path}: not valid YAML: {problem}") from problem
    if not isinstance(root, Section):
        raise error(f"{path}:1: must hold names and values, holds {shown(root)}")
    root.error = error
    return root


def _loader(path: Path) -> type[yaml.SafeLoader]:
    """A safe loader that makes mappings into sections and refuses a name given twice."""

    class Loader(yaml.SafeLoader):
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

    Loader.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, list("+-0123456789."))
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


def values_of(text: str, what: str) -> dict[str, Any]:
    """The names and values that `text_of` wrote, or that somebody typed; an empty text holds none.

    Raises
    ------
    SettingError
        If it is not a mapping in YAML; the message begins with `what`.
    """
    try:
        values = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise SettingError(f"{what}: not valid YAML: {' '.join(str(error).split())}") from error
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise SettingError(f"{what} = {shown(values)}: must hold names and values, as {{length: 0.1}}")
    return {str(name): _numbers(value) for name, value in values.items()}


def _plain(value: Any) -> Any:
    """What YAML has types for."""
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def name_and_value(change: str, example: str) -> tuple[str, Any]:
    """Split NAME=VALUE; the value is read as YAML, and 1e-3 as the number that it is.

    Raises
    ------
    SettingError
        If there is no "=", or the value is no YAML.
    """
    name, equals, text = change.partition("=")
    if not equals:
        raise SettingError(f"--set {change}: must have the form NAME=VALUE, as {example}")
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise SettingError(f"--set {change}: the value cannot be read: {error}") from error
    return name, _numbers(value)


def _numbers(value: Any) -> Any:
    """The value with 1e-3 as the number that it is; YAML 1.1 takes it for text."""
    if isinstance(value, dict):
        return {name: _numbers(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_numbers(element) for element in value]
    return float(value) if isinstance(value, str) and _EXPONENT.fullmatch(value) else value
