"""SettingsPanel: every setting of a node that changes at runtime, with range, unit and meaning.

A value that the node refuses stays as it was, and why is said. Each change can be undone and done again; what
differs from the values at the start is listed, and can be saved as a controller file. Two sets, A and B, are
kept to go to and fro between them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import viser
import yaml

from tactile_base.whole_file import whole_file
from tactile_view.words import set_html

PLAIN = (bool, int, float, str)
GROUPS_FIRST = ("task", "pid", "watchdog", "limiter")


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node: its value, and what its descriptor says."""

    name: str
    value: Any
    doc: str = ""
    lower: float | None = None
    upper: float | None = None
    choices: tuple[str, ...] = ()

    @property
    def group(self) -> str:
        """What stands before the first dot."""
        return self.name.partition(".")[0] if "." in self.name else "node"


@dataclass
class Changes:
    """Values at the start, in force, and the way between them.

    Attributes
    ----------
    first, now : name -> value
    sets : "A", "B" -> what was in force when it was left
    """

    first: dict[str, Any] = field(default_factory=dict)
    now: dict[str, Any] = field(default_factory=dict)
    done: list[tuple[str, Any, Any]] = field(default_factory=list)
    undone: list[tuple[str, Any, Any]] = field(default_factory=list)
    sets: dict[str, dict[str, Any]] = field(default_factory=dict)
    chosen: str = "A"

    def note(self, name: str, value: Any) -> None:
        """A value is in force now that a person has asked for."""
        self.done.append((name, self.now.get(name), value))
        self.now[name] = value
        self.undone.clear()

    def back(self) -> tuple[str, Any] | None:
        """The name and value that undo the last change; None for nothing to undo."""
        if not self.done:
            return None
        name, before, after = self.done.pop()
        self.undone.append((name, before, after))
        self.now[name] = before
        return name, before

    def again(self) -> tuple[str, Any] | None:
        """The name and value that do again what was undone."""
        if not self.undone:
            return None
        name, before, after = self.undone.pop()
        self.done.append((name, before, after))
        self.now[name] = after
        return name, after

    def different(self) -> dict[str, tuple[Any, Any]]:
        """Name -> value at the start and now, where they differ."""
        return {n: (self.first.get(n), v) for n, v in self.now.items() if v != self.first.get(n)}

    def to_other_set(self) -> dict[str, Any]:
        """Keep what is in force, and go to the other set: name -> value of what has to change."""
        self.sets[self.chosen] = dict(self.now)
        self.chosen = "B" if self.chosen == "A" else "A"
        other = self.sets.get(self.chosen, dict(self.now))
        return {name: value for name, value in other.items() if value != self.now.get(name)}


def controller_file(values: dict[str, Any], task: str) -> str:
    """A controller file of values by name, `pid.kp`, that the next launch takes with --controller."""
    groups: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        group, _, key = name.partition(".")
        if key:
            groups.setdefault(group, {})[key] = list(value) if isinstance(value, tuple | list) else value
    own = {group: groups.pop(group) for group in list(groups) if group == "task"}
    content: dict[str, Any] = {**groups, **({"tasks": {task: own}} if own else {})}
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


class SettingsPanel:
    """See the module's text.

    Parameters
    ----------
    ask : callable
        Of name and value: has the node take it; what came of it is told by `taken` or `refused`.
    """

    def __init__(self, server: viser.ViserServer, ask: Callable[[str, Any], None]) -> None:
        self._server, self._ask = server, ask
        self.changes, self._handles = Changes(), dict[str, Any]()
        self._parameters: dict[str, Parameter] = {}
        gui = server.gui
        self._said = gui.add_html("")
        self.say("no settings yet")
        row = gui.add_button_group("", ("undo", "redo", "A / B", "save"))
        row.on_click(lambda event: self._press(event.target.value))
        self._folder = gui.add_folder("settings")

    def fill(self, parameters: list[Parameter]) -> None:
        """Show these parameters of a node; their values are those at the start."""
        for handle in self._handles.values():
            handle.remove()
        self._parameters = {parameter.name: parameter for parameter in parameters}
        values = {name: parameter.value for name, parameter in self._parameters.items()}
        self.changes, self._handles = Changes(dict(values), dict(values)), {}
        order = sorted(self._parameters.values(), key=lambda p: (*GROUPS_FIRST, p.group).index(p.group))
        with self._folder:
            for parameter in order:
                self._handles[parameter.name] = self._add(parameter)
        self.say(f"{len(parameters)} settings; a changed one is in force at once")

    def say(self, text: str, ok: bool = True) -> None:
        """Tell what came of something."""
        color = "inherit" if ok else "#c01c1c"
        listed = "".join(
            f"<br>{escape(name)}: {escape(str(was))} → <b>{escape(str(now))}</b>"
            for name, (was, now) in self.changes.different().items()
        )
        set_html(self._said, f"<span style='color:{color}'>{escape(text)}</span>{listed}")

    def taken(self, name: str, value: Any) -> None:
        """The node has a value in force now that was asked for."""
        if self.changes.now.get(name) != value:
            self.changes.note(name, value)
        self._put(name, value)
        self.say(f"{name} = {value} is in force (set {self.changes.chosen})")

    def refused(self, name: str, why: str) -> None:
        """The node has refused: the element goes back."""
        self._put(name, self.changes.now.get(name))
        self.say(why, ok=False)

    # ---- elements ----

    def _add(self, parameter: Parameter) -> Any:
        gui, name, value = self._server.gui, parameter.name, parameter.value
        hint = parameter.doc or None
        if isinstance(value, bool):
            handle: Any = gui.add_checkbox(name, value, hint=hint)
        elif parameter.choices:
            handle = gui.add_dropdown(name, parameter.choices, initial_value=value, hint=hint)
        elif isinstance(value, int | float) and parameter.lower is not None and parameter.upper is not None:
            handle = gui.add_slider(
                name, parameter.lower, parameter.upper, _step(parameter), value, hint=hint
            )
        elif isinstance(value, int | float):
            handle = gui.add_number(name, value, hint=hint)
        else:
            handle = gui.add_text(name, _text(value), hint=hint)
        handle.on_update(lambda event: self._changed(name, event))
        return handle

    def _changed(self, name: str, event: Any) -> None:
        """An element has a new value: by a person, or by us, where there is no client."""
        value = _value(event.target.value, self.changes.now.get(name))
        if event.client is not None and value != self.changes.now.get(name):
            self._ask(name, value)

    def _put(self, name: str, value: Any) -> None:
        if (handle := self._handles.get(name)) is not None:
            handle.value = value if isinstance(value, PLAIN) else _text(value)

    def _press(self, button: str) -> None:
        changes = self.changes
        if button in ("undo", "redo"):
            found = changes.back() if button == "undo" else changes.again()
            if found is None:
                self.say(f"nothing to {button}")
            else:
                self._ask(*found)
        elif button == "save":
            self._save()
        else:
            for name, value in changes.to_other_set().items():
                self._ask(name, value)
            self.say(f"set {changes.chosen}")

    def _save(self) -> None:
        different = {name: now for name, (_, now) in self.changes.different().items()}
        if not different:
            self.say("nothing differs from the values at the start, so there is nothing to save")
            return
        path = Path("out/view/controller.yaml")
        path.parent.mkdir(parents=True, exist_ok=True)
        task = str(self.changes.now.get("task", ""))
        with whole_file(path) as temporary:
            temporary.write_text(controller_file(different, task))
        self.say(f"saved as {path}: tactile launch {task} --controller {path}")


def _step(parameter: Parameter) -> float:
    """Of a slider: whole numbers, or a thousandth of the range."""
    assert parameter.lower is not None and parameter.upper is not None
    return 1 if isinstance(parameter.value, int) else (parameter.upper - parameter.lower) / 1000.0


def _text(value: Any) -> str:
    return (
        yaml.safe_dump(list(value), default_flow_style=True).strip() if not isinstance(value, str) else value
    )


def _value(shown: Any, before: Any) -> Any:
    """What an element shows, as the parameter has it; a text that is none of its kind stays a text."""
    if isinstance(before, str) or not isinstance(shown, str):
        return shown
    try:
        found = yaml.safe_load(shown)
    except yaml.YAMLError:
        return shown
    return tuple(found) if isinstance(found, list) else found
