"""Settings: frozen dataclasses whose fields carry unit, range and meaning.

One declaration is the source of the default, the validation, the ROS parameter and the documentation of a
number. A settings object is valid from the moment it exists, and is replaced, never changed, so that a value
refused at runtime leaves the old one in force::

    @dataclass(frozen=True)
    class GateSettings(Settings):
        probability: float = setting(0.999, lower=0.0, upper=1.0, doc="probability kept by the gate")
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

S = TypeVar("S", bound="Settings")
G = TypeVar("G", bound="SettingGroups")
#: Of a number, or of each element of a list of numbers.
Bound = float | Sequence[float] | None
#: Bounds of a pose as Euler numbers: in a cell, within 10 m, and no more than a whole turn.
LARGEST_POSE = (10.0,) * 3 + (2.0 * math.pi,) * 3
SMALLEST_POSE = tuple(-bound for bound in LARGEST_POSE)
#: Of every random generator that is used.
LARGEST_SEED = 2**32 - 1


class SettingError(ValueError):
    """A setting that has no such name, the wrong type, or a value outside its range."""


def setting(
    default: Any = dataclasses.MISSING,
    *,
    doc: str,
    unit: str = "",
    lower: Bound = None,
    upper: Bound = None,
    choices: tuple[Any, ...] | None = None,
    length: int | None = None,
) -> Any:
    """Declare one field of a `Settings` class.

    A list default is stored as a tuple. `lower` and `upper` are inclusive and, like `choices`, hold for every
    element of a list, or are lists with a bound for each. A number has to be finite; infinity is taken only
    where `upper` says so by being infinite, and `doc` should say what it means there. `length` is the number
    of a list's elements. Where units differ among these, `unit` names them in equal parts ("m, rad" of six:
    three in m, three in rad). An empty default is that of a list of numbers if it has bounds, else of texts.
    """
    if isinstance(default, list):
        default = tuple(default)
    metadata = {
        "doc": doc, "unit": unit, "lower": lower, "upper": upper, "choices": choices, "length": length,
    }  # fmt: skip
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Settings:
    """Base of all settings; validates on construction and raises `SettingError`."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = _coerce(field, getattr(self, field.name))
            _check_range(field, value)
            object.__setattr__(self, field.name, value)

    @classmethod
    def from_mapping(cls: type[S], values: Mapping[str, Any], where: str = "") -> S:
        """Build from names and values; `where` (a file and line) goes into the error's message."""
        names = [field.name for field in dataclasses.fields(cls)]
        prefix = f"{where}: " if where else ""
        for name in values:
            if name not in names:
                raise SettingError(prefix + unknown_name(name, names))
        try:
            return cls(**values)
        except (SettingError, TypeError) as error:
            raise SettingError(f"{prefix}{error}") from error

    def replaced(self: S, **changes: Any) -> S:
        """A copy with some values changed and all of them validated again."""
        return type(self).from_mapping({**dataclasses.asdict(self), **changes})


@dataclass(frozen=True)
class SettingGroups:
    """Several `Settings` by name: all that can be set of one thing, a controller for instance.

    Each field of a subclass is one group, with a `Settings` class as its `default_factory`::

        @dataclass(frozen=True)
        class ChainSettings(SettingGroups):
            pid: PidSettings = field(default_factory=PidSettings)
    """

    @classmethod
    def group_names(cls) -> tuple[str, ...]:
        """Names of the groups."""
        return tuple(item.name for item in dataclasses.fields(cls))

    def group(self, name: str) -> Settings:
        """One of the groups by its name."""
        value: Settings = getattr(self, name)
        return value

    def dotted(self) -> dict[str, Any]:
        """All values by GROUP.NAME, as parameters of a node are called."""
        groups = {name: dataclasses.asdict(self.group(name)) for name in self.group_names()}
        return {
            f"{group}.{name}": value for group, values in groups.items() for name, value in values.items()
        }

    @classmethod
    def from_mapping(cls: type[G], values: Mapping[str, Any], where: str = "") -> G:
        """Build from {group: {name: value}}; raises `SettingError` that says what was wrong and `where`."""
        return cls().merged(values, where)

    def merged(self: G, values: Mapping[str, Any], where: str = "") -> G:
        """A copy with the values of {group: {name: value}} in place, the others as they are."""
        prefix = f"{where}: " if where else ""
        changed: dict[str, Any] = {}
        for name, changes in values.items():
            if name not in self.group_names():
                raise SettingError(prefix + unknown_name(name, self.group_names()))
            if not isinstance(changes, Mapping):
                raise SettingError(f"{prefix}{name} must hold names and values, is {shown(changes)}")
            group = self.group(name)
            values_now = {**dataclasses.asdict(group), **changes}
            changed[name] = type(group).from_mapping(values_now, f"{prefix}{name}")
        return dataclasses.replace(self, **changed)

    def replaced(self: G, **changes: Any) -> G:
        """A copy with values changed by `group__name`: `replaced(pid__kp=[...], task__speed=0.02)`."""
        nested: dict[str, dict[str, Any]] = {}
        for name, value in changes.items():
            group, _, key = name.partition("__")
            nested.setdefault(group, {})[key] = value
        return self.merged(nested)


def unknown_name(name: str, choices: list[str] | tuple[str, ...]) -> str:
    """The message for a name that is not among the choices, with the nearest one if it looks like a typo."""
    near = difflib.get_close_matches(name, choices, n=1)
    hint = f" (did you mean '{near[0]}'?)" if near else ""
    return f"unknown name '{name}'{hint}; valid: {', '.join(sorted(choices))}"


def _coerce(field: dataclasses.Field[Any], value: Any) -> Any:
    """The value in the type of the field's default: int to float, list to tuple; anything else is refused."""
    if field.default is dataclasses.MISSING:
        return value
    if isinstance(field.default, tuple):
        return _coerce_sequence(field, value)
    return _coerce_scalar(field.name, field.default, value)


def _coerce_sequence(field: dataclasses.Field[Any], value: Any) -> tuple[Any, ...]:
    if isinstance(value, str | Mapping) or not hasattr(value, "__len__"):
        raise SettingError(f"{field.name} = {shown(value)}: must be a list")
    length = field.metadata.get("length")
    if length is not None and len(value) != length:
        raise SettingError(f"{field.name}: must have {length} elements, has {len(value)}")
    default: Any = field.default
    lower = field.metadata.get("lower")
    kind = default[0] if default else "" if lower is None else type(lower)()
    return tuple(_coerce_scalar(f"{field.name}[{k}]", kind, element) for k, element in enumerate(value))


def _coerce_scalar(name: str, default: Any, value: Any) -> Any:
    if hasattr(value, "item"):
        value = value.item()
    expected = type(default)
    if expected is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not expected:
        raise SettingError(
            f"{name} = {shown(value)}: must be of type {expected.__name__}, is {type(value).__name__}"
        )
    if isinstance(value, float) and math.isnan(value):
        raise SettingError(f"{name}: is not a number")
    return value


def shown(value: Any) -> str:
    """A value as messages quote it, in no more than 60 characters."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def bounds_of(metadata: Mapping[str, Any], index: int) -> tuple[float | None, float | None]:
    """Lower and upper bound of a field's element."""
    lower, upper = (
        bound[index] if isinstance(bound, Sequence) else bound
        for bound in (metadata.get("lower"), metadata.get("upper"))
    )
    return lower, upper


def range_text(lower: float | None, upper: float | None) -> str:
    """The range in a message: [0, 1]; infinity itself is outside of [0, inf)."""
    return ("(-inf, " if lower is None else f"[{lower:g}, ") + ("inf)" if upper is None else f"{upper:g}]")


def _check_range(field: dataclasses.Field[Any], value: Any) -> None:
    choices = field.metadata.get("choices")
    several = isinstance(value, tuple)
    for index, element in enumerate(value if several else (value,)):
        name = f"{field.name}[{index}]" if several else field.name
        if choices is not None and element not in choices:
            raise SettingError(f"{name} = {shown(element)}: must be one of {', '.join(map(str, choices))}")
        lower, upper = bounds_of(field.metadata, index)
        below, above = lower is not None and element < lower, upper is not None and element > upper
        endless = isinstance(element, float) and math.isinf(element) and upper != math.inf
        if below or above or endless:
            unit = _unit(field, index)
            range_ = range_text(lower, upper)
            raise SettingError(f"{name} = {shown(element)}{unit}: must lie in {range_}{unit}")


def _unit(field: dataclasses.Field[Any], index: int) -> str:
    """The unit of an element, with a blank before it."""
    parts = (field.metadata.get("unit") or "").split(", ")
    part = parts[index * len(parts) // (field.metadata.get("length") or 1)] if len(parts) > 1 else parts[0]
    return f" {part}" if part else ""
