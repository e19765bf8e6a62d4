"""Tuning: settings of running nodes, changed by hand; what `tactile tune` and the page in the browser share.

It keeps what is in force, with which value each node was started, what a person has changed, and two sets, A
and B, to go to and fro between. It sends nothing: who asks for a `Request` has the nodes take it, and says
with `finished` what came of it; `heard` tells it what nodes say has changed, whoever did it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from tactile_base.settings import SettingError
from tactile_base.yaml_file import STARTED_WITH, typed_value, value_text

Key = tuple[str, str]  #: full name of the node, name of the parameter
Step = dict[Key, tuple[Any, Any]]  #: what a person has changed at once: value before and after
NOT_OURS = ("use_sim_time", "start_type_description_service")  # of every node in ROS
GROUPS_FIRST = ("task", "pid", "watchdog", "limiter")
UNDO, REDO, OTHER_SET = "undo", "redo", "other set"


def plain(value: Any, kind: type = tuple) -> Any:
    """A value of a parameter; lists and arrays as tuples, which compare by value, or as `kind`."""
    listed = isinstance(value, list | tuple) or hasattr(value, "tolist")
    return kind(value) if listed else value


@dataclass(frozen=True)
class RuntimeSetting:
    """One parameter of a node, and what its descriptor says.

    Attributes
    ----------
    value, start : what it was when it was looked at, and when its node began
    doc : meaning, unit, and what its range cannot say
    bounds : range in words, of each element where they differ
    lower, upper : range of a number; None where a side is open, or for a list
    fixed : whether it cannot change while the node runs
    """

    node: str
    name: str
    value: Any
    start: Any
    doc: str = ""
    bounds: str = ""
    lower: float | None = None
    upper: float | None = None
    choices: tuple[str, ...] = ()
    fixed: bool = False

    @property
    def group(self) -> str:
        """What stands before the first dot."""
        return self.name.partition(".")[0] if "." in self.name else "node"

    @property
    def order(self) -> tuple[int, str]:
        """What a person changes most comes first."""
        at = GROUPS_FIRST.index(self.group) if self.group in GROUPS_FIRST else len(GROUPS_FIRST)
        return at, self.name

    def parsed(self, text: str) -> Any:
        """What somebody typed as a value of this; `SettingError` where it is no YAML."""
        return text if isinstance(self.value, str) else plain(typed_value(text, self.name))


def runtime_setting(node: str, name: str, value: Any, descriptor: Any) -> RuntimeSetting:
    """Of the value and the rcl_interfaces/ParameterDescriptor of a parameter."""
    value = plain(value)
    doc, marked, start = descriptor.description.rpartition(STARTED_WITH)
    bounds = descriptor.additional_constraints
    ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
    choices: tuple[str, ...] = ()
    if isinstance(value, str) and bounds.startswith("one of "):
        choices = tuple(bounds.removeprefix("one of ").split("; ")[0].split(", "))
    lower, upper = (ranges[0].from_value, ranges[0].to_value) if ranges else (None, None)
    return RuntimeSetting(
        node,
        name,
        value,
        start=plain(typed_value(start, name)) if marked else value,
        doc=doc if marked else start,
        bounds=bounds or (f"in [{lower:g}, {upper:g}]" if ranges else ""),
        lower=lower,
        upper=upper,
        choices=choices if value in choices else (),
        fixed=descriptor.read_only or name in NOT_OURS or name.startswith("qos_overrides"),
    )


@dataclass(eq=False)
class Request:
    """What nodes are asked to take; of an undo or redo the `step`, and of each change what was `before`."""

    changes: Mapping[Key, Any]
    way: str = ""
    step: Step = field(default_factory=dict)
    before: dict[Key, Any] = field(default_factory=dict)

    def by_node(self) -> dict[str, dict[str, Any]]:
        """Node -> name -> value."""
        found: dict[str, dict[str, Any]] = {}
        for (node, name), value in self.changes.items():
            found.setdefault(node, {})[name] = value
        return found


class Tuning:
    """See the module's text.

    Attributes
    ----------
    settings : those of all nodes that were found
    now : what is in force
    chosen : "A" or "B"
    """

    def __init__(self) -> None:
        self.settings: dict[Key, RuntimeSetting] = {}
        self.now: dict[Key, Any] = {}
        self.chosen = "A"
        self._sets: dict[str, dict[Key, Any]] = {}  # what was in force when a set was left
        self._done: list[Step] = []
        self._undone: list[Step] = []
        self._expected: dict[Key, list[Request]] = {}  # of which no node has told yet
        self._asked = 0

    @property
    def nodes(self) -> list[str]:
        """Those that were found, by name."""
        return sorted({node for node, _ in self.settings})

    def found(self, node: str, settings: Collection[RuntimeSetting]) -> None:
        """A node is there, perhaps again, with these settings."""
        self.gone(node)
        self.settings |= {(node, setting.name): setting for setting in settings}
        self.now |= {(node, setting.name): setting.value for setting in settings}

    def gone(self, node: str) -> None:
        """A node is there no more."""
        for known in (self.settings, self.now, self._expected):
            for key in [key for key in known if key[0] == node]:
                del known[key]

    def different(self) -> dict[Key, tuple[Any, Any]]:
        """The value that the node was started with and the one in force, where they differ."""
        starts = {key: setting.start for key, setting in self.settings.items()}
        return {key: (starts[key], now) for key, now in self.now.items() if now != starts[key]}

    # ---- what a person wants; each raises SettingError where it cannot be done ----

    def change(self, changes: Mapping[Key, Any]) -> Request:
        """New values."""
        for key in changes:
            if self.settings[key].fixed:
                raise SettingError(f"{key[1]}: cannot change while {key[0]} runs")
        return self._request(Request(changes))

    def undo(self) -> Request:
        """Back to what was before the last change that a person has made here."""
        step = self._last(self._done, UNDO, 1)
        return self._request(Request({key: before for key, (before, _) in step.items()}, UNDO, step))

    def redo(self) -> Request:
        """Again what was undone last."""
        step = self._last(self._undone, REDO, 0)
        return self._request(Request({key: after for key, (_, after) in step.items()}, REDO, step))

    def other_set(self) -> Request:
        """What is in force is set A from now on, and set B comes in force; or the other way round."""
        self._wait()
        self._sets[self.chosen] = dict(self.now)
        other = self._sets.get("B" if self.chosen == "A" else "A", self.now)
        changes = {key: value for key, value in other.items() if value != self.now.get(key, value)}
        return self._request(Request(changes, OTHER_SET))

    def _last(self, steps: list[Step], way: str, side: int) -> Step:
        """The last step, of which that side is still in force; one that is not is dropped, and told."""
        self._wait()
        if not steps:
            raise SettingError(f"nothing to {way}")
        step = steps.pop()
        for (node, name), values in step.items():
            now = self.now.get((node, name))
            if now != values[side]:
                what = f"{node} {name} = {value_text(values[side])}"
                why = "its node is gone" if now is None else f"it is {value_text(now)} by somebody else"
                raise SettingError(f"no {way} of {what}: {why}; {way} again goes on to what was before")
        return step

    def _wait(self) -> None:
        if self._asked:
            raise SettingError("the last change is still being asked for")

    def _request(self, request: Request) -> Request:
        self._asked += 1
        for key in request.changes:
            self._expected.setdefault(key, []).append(request)
        return request

    # ---- what has become of it ----

    def finished(self, request: Request, taken: Collection[Key]) -> None:
        """Nodes have taken these of the changes, and refused the others."""
        self._asked -= 1
        step: Step = {}
        for key, value in request.changes.items():
            if key not in taken:
                expected = self._expected.get(key, [])
                expected[:] = [other for other in expected if other is not request]
                continue
            if key not in request.before and key in self.settings:  # else its node has told of it already
                request.before[key], self.now[key] = self.now[key], value
            step[key] = request.step.get(key, (request.before.get(key), value))
        rest = {key: values for key, values in request.step.items() if key not in taken}
        came_from, goes_to = self._done, self._undone
        if request.way != UNDO:
            came_from, goes_to = goes_to, came_from
        came_from += [rest] if rest else []
        goes_to += [step] if step else []
        if step and request.way not in (UNDO, REDO):
            self._undone.clear()
        if request.way == OTHER_SET and len(taken) == len(request.changes):
            self.chosen = "B" if self.chosen == "A" else "A"

    def heard(self, node: str, name: str, value: Any) -> str:
        """A node tells that a value is in force; returns what to say if somebody else has done it, or ''."""
        key, value = (node, name), plain(value)
        if key not in self.settings:
            return ""
        expected, before = self._expected.get(key, []), self.now[key]
        at = next((at for at, request in enumerate(expected) if request.changes[key] == value), None)
        if at is not None:
            was = before
            for request in expected[: at + 1]:
                if key not in request.before:
                    request.before[key], self.now[key] = was, value
                was = request.changes[key]
            del expected[: at + 1]
            return ""
        self.now[key] = value
        if value == before:
            return ""
        for values in self._sets.values():
            values[key] = value
        return f"{node} {name} = {value_text(value)} by somebody else, was {value_text(before)}"
