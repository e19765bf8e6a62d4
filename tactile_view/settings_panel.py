"""SettingsPanel: the settings of a node that change at runtime, with range, unit and meaning (`Tuning`)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Coroutine, Sequence
from html import escape
from typing import Any

import viser

from tactile_base.settings import SettingError
from tactile_base.yaml_file import value_text
from tactile_bringup.tuning import Request, RuntimeSetting, Tuning
from tactile_bringup.tuning_files import saved
from tactile_view.in_loop import handler
from tactile_view.words import set_html

PLAIN = (bool, int, float, str)
FINEST = 1e-6  # of a number: the page rounds to it
TANGENT = 6  # numbers: x, y, z, then about them


class SettingsPanel:
    """Shows the settings of one node at a time; a value that the node refuses goes back, and why is said.

    Parameters
    ----------
    ask : callable
        Has nodes take what a request wants; what came of it is told by `finished`.
    """

    def __init__(self, server: viser.ViserServer, ask: Callable[[Request], None]) -> None:
        self._server, self._ask = server, ask
        self.tuning, self._node, self._handles = Tuning(), "", dict[str, Any]()
        gui = server.gui
        self._said = gui.add_html("")
        self.say("no settings yet")
        row = gui.add_button_group("", ("undo", "redo", "A / B", "save"))
        row.on_click(handler(lambda event: self._press(event.target.value)))
        self._folder = gui.add_folder("settings")

    def fill(self, node: str, settings: Collection[RuntimeSetting]) -> None:
        """Show those of these settings of a node that can change while it runs."""
        for handle in self._handles.values():
            handle.remove()
        self.tuning.found(node, settings)
        self._node, self._handles = node, {}
        shown = sorted((each for each in settings if not each.fixed), key=lambda each: each.order)
        with self._folder:
            for setting in shown:
                self._handles[setting.name] = self._add(setting)
        self.say(f"{len(shown)} settings; a changed one is in force at once")

    def say(self, text: str, ok: bool = True) -> None:
        """Tell what came of something, and what differs from what the nodes were started with."""
        color = "inherit" if ok else "#c01c1c"
        listed = "".join(
            f"<br>{escape(name)}: {escape(value_text(was))} → <b>{escape(value_text(now))}</b>"
            for (_, name), (was, now) in self.tuning.different().items()
        )
        set_html(self._said, f"<span style='color:{color}'>{escape(text)}</span>{listed}")

    def heard(self, node: str, name: str, value: Any) -> None:
        """A node says that a value is in force, whoever asked for it."""
        if other := self.tuning.heard(node, name, value):
            self.say(other)
        self._put(node, name)

    def finished(self, request: Request, taken: Collection[tuple[str, str]], refusals: list[str]) -> None:
        """Nodes have taken these of the changes, and refused the others, whose elements go back."""
        self.tuning.finished(request, taken)
        for key, asked in request.changes.items():
            if key in taken or self._shows(key[1], asked):  # else somebody has gone on meanwhile
                self._put(*key)
        told = [f"{name} = {value_text(self.tuning.now[node, name])} is in force" for node, name in taken]
        self.say("; ".join(refusals or [*told, f"set {self.tuning.chosen}"]), not refusals)

    # ---- elements ----

    def _add(self, setting: RuntimeSetting) -> Any:
        gui, name, value, lower, upper = (
            self._server.gui, setting.name, setting.value, setting.lower, setting.upper,
        )  # fmt: skip
        hint = setting.doc or None
        if isinstance(value, bool):
            handle: Any = gui.add_checkbox(name, value, hint=hint)
        elif setting.choices:
            handle = gui.add_dropdown(name, setting.choices, initial_value=value, hint=hint)
        elif isinstance(value, int | float) and lower is not None and upper is not None:
            step = 1 if isinstance(value, int) else (upper - lower) / 1000.0
            handle = gui.add_slider(name, lower, upper, step, value, hint=hint)
        elif isinstance(value, int | float):
            handle = gui.add_number(name, value, hint=hint)
        elif len(value) == TANGENT and all(isinstance(each, float) for each in value):
            handle = _SixNumbers(gui, name, value, hint)
        else:
            handle = gui.add_text(name, _shown(value), hint=hint)
        handle.on_update(handler(lambda event: self._changed(setting, event)))
        return handle

    def _changed(self, setting: RuntimeSetting, event: Any) -> None:
        """An element has a new value: by a person, or by us, where there is no client."""
        if event.client is None:
            return
        key, value = (setting.node, setting.name), self._handles[setting.name].value
        try:
            value = setting.parsed(value) if isinstance(value, str) else value
        except SettingError as error:
            self._put(*key)
            self.say(str(error), ok=False)
            return
        if value != self.tuning.now.get(key):
            self._want(lambda: self.tuning.change({key: value}))

    def _shows(self, name: str, value: Any) -> bool:
        handle = self._handles.get(name)
        return handle is not None and handle.value == _as_shown(handle, value)

    def _put(self, node: str, name: str) -> None:
        if node == self._node and (handle := self._handles.get(name)) is not None:
            handle.value = _as_shown(handle, self.tuning.now[node, name])

    def _press(self, button: str) -> None:
        if button == "save":
            self._save()
        else:
            ways = {"undo": self.tuning.undo, "redo": self.tuning.redo}
            self._want(ways.get(button, self.tuning.other_set))

    def _want(self, make: Callable[[], Request]) -> None:
        try:
            self._ask(make())
        except SettingError as error:
            self.say(str(error), ok=False)

    def _save(self) -> None:
        try:
            self.say("saved: " + "; ".join(saved(self.tuning)))
        except (SettingError, OSError) as error:
            self.say(str(error), ok=False)


def _as_shown(handle: Any, value: Any) -> Any:
    return value if isinstance(handle, _SixNumbers) else _shown(value)


def _shown(value: Any) -> Any:
    """A value as an element has it; of a list its text."""
    return value if isinstance(value, PLAIN) else value_text(value)


class _SixNumbers:
    """An element of two rows, for a list of six: along x, y and z, and about them."""

    def __init__(self, gui: Any, name: str, value: Sequence[float], hint: str | None) -> None:
        self._rows = [
            gui.add_vector3(f"{name} {axes}", tuple(value[k : k + 3]), step=FINEST, hint=hint)
            for k, axes in ((0, "x y z"), (3, "α β γ"))
        ]

    @property
    def value(self) -> tuple[float, ...]:
        return tuple(float(each) for row in self._rows for each in row.value)

    @value.setter
    def value(self, value: Sequence[float]) -> None:
        for k, row in enumerate(self._rows):
            row.value = tuple(value[3 * k : 3 * k + 3])

    def on_update(self, call: Callable[[Any], Coroutine[Any, Any, None]]) -> None:
        for row in self._rows:
            row.on_update(call)

    def remove(self) -> None:
        for row in self._rows:
            row.remove()
