"""ROS parameters from a Settings class: one declaration of default, range, unit and meaning serves both.

The settings in force are always a whole, valid object. A refused value leaves the old one in force and the
reason names the parameter, the value and its range. Nodes run one callback at a time, so a change takes
effect between two steps and never within one.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Sequence
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from tactile_base.settings import SettingError, SettingGroups, Settings, bounds_of, range_text
from tactile_base.yaml_file import STARTED_WITH, value_text

G = TypeVar("G", bound=SettingGroups)
S = TypeVar("S", bound=Settings)
INT32 = 1 << 31


class SettingsParameters(Generic[S]):
    """Declares one ROS parameter a field on `node` and keeps `value`, the settings in force, up to date.

    Parameters
    ----------
    defaults : Settings
        The values where neither a parameter file nor the command line says otherwise.
    prefix : str
        Put before each field's name with a dot ("pid.kp"); '' for none.
    on_change : callable, optional
        Called with the new settings after a change at runtime was accepted.
    read_only : collection of str
        Fields that cannot change while the node runs.

    Raises
    ------
    SettingError
        If a value given at start has the wrong type or lies outside its range.
    """

    def __init__(
        self,
        node: Node,
        defaults: S,
        *,
        prefix: str = "",
        on_change: Callable[[S], None] | None = None,
        read_only: Collection[str] = (),
    ) -> None:
        self._prefix = f"{prefix}." if prefix else ""
        self._on_change = on_change
        self._names = {self._prefix + field.name: field.name for field in dataclasses.fields(defaults)}
        initial = {
            field.name: _declare(
                node, self._prefix + field.name, field, getattr(defaults, field.name), read_only
            )
            for field in dataclasses.fields(defaults)
        }
        try:
            self.value: S = defaults.replaced(**initial)
        except SettingError as error:
            raise SettingError(f"parameter {self._prefix}{error}") from error
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._apply)

    def _changed(self, parameters: Sequence[Parameter[Any]]) -> S | None:
        """The settings with these parameters in them; None where none of them is ours."""
        changes = {self._names[p.name]: _plain(p.value) for p in parameters if p.name in self._names}
        return self.value.replaced(**changes) if changes else None

    def _validate(self, parameters: Sequence[Parameter[Any]]) -> SetParametersResult:
        try:
            self._changed(parameters)
        except SettingError as error:
            return SetParametersResult(successful=False, reason=f"{self._prefix}{error}")
        return SetParametersResult(successful=True)

    def _apply(self, parameters: Sequence[Parameter[Any]]) -> None:
        value = self._changed(parameters)
        if value is None or value == self.value:
            return
        self.value = value
        if self._on_change is not None:
            self._on_change(value)


def fixed_settings(node: Node, defaults: S, prefix: str) -> S:
    """Declare settings that cannot change while the node runs, and return them."""
    names = [field.name for field in dataclasses.fields(defaults)]
    return SettingsParameters(node, defaults, prefix=prefix, read_only=names).value


class GroupParameters(Generic[G]):
    """One ROS parameter a setting of several groups, "pid.kp" for instance, and `value`, all in force.

    `on_change` is called without arguments after a change at runtime was accepted.
    """

    def __init__(self, node: Node, defaults: G, on_change: Callable[[], None]) -> None:
        self._type = type(defaults)
        self._groups: dict[str, SettingsParameters[Settings]] = {
            name: SettingsParameters(
                node, defaults.group(name), prefix=name, on_change=lambda changed: on_change()
            )
            for name in defaults.group_names()
        }

    @property
    def value(self) -> G:
        """The settings in force."""
        values: dict[str, Any] = {name: group.value for name, group in self._groups.items()}
        return self._type(**values)


def refusing_unknown_types(serve: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """What serves `SetParameters` or `SetParametersAtomically`, but sets nothing where a type is none.

    rclpy's own (`rclpy.parameter_service`) raises for one, which would end the node.
    """
    types = [each.value for each in Parameter.Type]

    def answer(request: Any, response: Any) -> Any:
        unknown = [each for each in request.parameters if each.value.type not in types]
        if not unknown:
            return serve(request, response)
        name, number = unknown[0].name, unknown[0].value.type
        reason = f"nothing was set: {name} is of type {number}, types are 0 to {max(types)}"
        refused = SetParametersResult(successful=False, reason=reason)
        if hasattr(response, "results"):
            response.results = [refused] * len(request.parameters)
        else:
            response.result = refused
        return response

    return answer


def meant(node: Node, parameters: Sequence[Parameter[Any]]) -> list[Parameter[Any]]:
    """What is to be set by parameters of the types that tools guess; a read-only one that stays is left out.

    `ros2 param load` and `set` guess from text (`rclpy.parameter.get_parameter_value`): to them 1e-05 and inf
    are strings, and [] holds bools. So what `ros2 param dump` writes is taken as it was.
    """
    found = []
    for given in parameters:
        if node.has_parameter(given.name):
            now = node.get_parameter(given.name)
            given = _as_type(given, now.type_)
            same = given.type_ is now.type_ and _plain(given.value) == _plain(now.value)
            if same and node.describe_parameter(given.name).read_only:
                continue
        found.append(given)
    return found


def _as_type(given: Parameter[Any], kind: Parameter.Type) -> Parameter[Any]:
    """The value as one of a type, where it is a text of numbers or empty; else as it is, to be refused."""
    value, types = given.value, Parameter.Type
    try:
        if kind is types.DOUBLE and given.type_ is types.STRING:
            value = float(value)
        elif kind is types.DOUBLE_ARRAY and given.type_ in (types.STRING, types.STRING_ARRAY):
            texts = value.strip("[]").split(",") if isinstance(value, str) else value
            value = [float(text) for text in texts]
        elif not (given.type_ is types.BOOL_ARRAY and len(value) == 0 and kind.name.endswith("_ARRAY")):
            return given
    except ValueError:
        return given
    return Parameter(given.name, kind, value)


def declare_read_only(node: Node, name: str, default: Any, description: str) -> Any:
    """Declare a parameter that is fixed once the node runs, and return its value."""
    descriptor = ParameterDescriptor(description=description, read_only=True)
    return _declared_value(node, name, default, descriptor)


def _declare(
    node: Node, name: str, field: dataclasses.Field[Any], default: Any, read_only: Collection[str]
) -> Any:
    descriptor = _descriptor(field, default)
    descriptor.read_only = field.name in read_only
    value = _declared_value(node, name, list(default) if isinstance(default, tuple) else default, descriptor)
    if not descriptor.read_only:  # known only now, and `set_descriptor` would tell everybody of a change
        node.describe_parameter(name).description += f"{STARTED_WITH}{value_text(value)}"
    return value


def _declared_value(node: Node, name: str, default: Any, descriptor: ParameterDescriptor) -> Any:
    """Declare, and say in plain words what was wrong with a value that was given at start."""
    empty = isinstance(default, list) and not default  # which tells no type, and stands for numbers
    kind = Parameter.Type.DOUBLE_ARRAY if empty else Parameter.Type.from_parameter_value(default)
    descriptor.type = kind.value
    try:
        value = node.declare_parameter(name, default, descriptor).value
    except InvalidParameterTypeException as error:
        raise SettingError(f"parameter {name}: must be of type {kind.name}: {error}") from error
    except InvalidParameterValueException as error:
        raise SettingError(f"parameter {name}: {error}") from error
    return _plain(value)


def _plain(value: Any) -> Any:
    """Arrays of parameters as tuples, so that settings compare by value."""
    return value if isinstance(value, bool | int | float | str) else tuple(value)


def _descriptor(field: dataclasses.Field[Any], default: Any) -> ParameterDescriptor:
    """Of a field; `Settings` checks what a range cannot say here, and the description tells it.

    rqt_reconfigure (param_editors.py, branch rolling) shows the description, and a slider for a range. It
    divides by the width of the range, and its sliders have 32 bits: a range without end, or a larger one,
    keeps it from showing this parameter and all that follow. No step: nodes would refuse what lies between.
    """
    meta = field.metadata
    descriptor = ParameterDescriptor(additional_constraints=_constraints(meta))
    lower, upper = meta.get("lower"), meta.get("upper")
    if isinstance(default, int | float) and lower is not None and upper is not None and lower < upper:
        if isinstance(default, int) and lower >= -INT32 and upper < INT32:
            descriptor.integer_range = [IntegerRange(from_value=int(lower), to_value=int(upper), step=0)]
        elif isinstance(default, float) and math.isfinite(upper - lower):
            ends = {"from_value": float(lower), "to_value": float(upper)}
            descriptor.floating_point_range = [FloatingPointRange(**ends, step=0.0)]
    unit = meta.get("unit") or ""
    told = unit and not descriptor.additional_constraints.endswith(unit)
    parts = (f"{meta.get('doc', '')}{f' ({unit})' if told else ''}", descriptor.additional_constraints)
    descriptor.description = "; ".join(filter(None, parts))
    return descriptor


def _constraints(meta: Any) -> str:
    parts = []
    if meta.get("choices") is not None:
        parts.append(f"one of {', '.join(map(str, meta['choices']))}")
    if meta.get("length") is not None:
        parts.append(f"{meta['length']} elements")
    ranges = [range_text(*bounds_of(meta, index)) for index in range(meta.get("length") or 1)]
    if ranges[0] != range_text(None, None):
        unit = f" {meta['unit']}" if meta.get("unit") else ""
        parts.append(f"in {', '.join(ranges if len(set(ranges)) > 1 else ranges[:1])}{unit}")
    return "; ".join(parts)
