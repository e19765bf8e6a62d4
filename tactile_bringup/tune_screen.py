"""TuneScreen: a table of settings in a terminal, on which keys act; it knows neither terminal nor ROS."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.layout import Layout
from rich.table import Table
from rich.text import Text

from tactile_base.settings import SettingError
from tactile_base.yaml_file import value_text
from tactile_bringup.tuning import Key, Request, RuntimeSetting, Tuning
from tactile_bringup.tuning_files import FOLDER, saved

HELP = """\
up, down, page up, page down, home, end   choose a setting; tab: the next node
enter     type a value: in force at once, or refused and why; escape: leave it
u, r      undo and redo what was changed here
s         go to the other of two sets, A and B, and back
d         what differs from what the nodes were started with
w         write it into files, or into a task file, that the next launch takes
/         show only what has this text in it, node or name
f         show those, too, that cannot change while their node runs
q         end; nothing is taken back
""".splitlines()
SHORT = "enter change  u undo  r redo  s A/B  d differs  w write  / find  ? help  q end"
DETAILS, MESSAGE, NAME = 5, 2, 28  # lines; letters of a name
_NAMES = {
    "\x1b[A": "up", "\x1bOA": "up", "\x1b[B": "down", "\x1bOB": "down", "\x1b[C": "right", "\x1bOC": "right",
    "\x1b[D": "left", "\x1bOD": "left", "\x1b[5~": "page up", "\x1b[6~": "page down", "\x1b[H": "home",
    "\x1bOH": "home", "\x1b[1~": "home", "\x1b[F": "end", "\x1bOF": "end", "\x1b[4~": "end",
    "\x1b[3~": "delete", "\x1b": "escape", "\r": "enter", "\n": "enter", "\t": "tab", "\x7f": "backspace",
    "\x08": "backspace", "\x01": "home", "\x05": "end", "\x15": "clear",
}  # fmt: skip
_KEY = re.compile(r"\x1b(?:\[[0-9;]*[A-Za-z~]|O[A-Za-z])|.", re.DOTALL)


def keys_of(typed: str) -> Iterator[str]:
    """What was typed, key by key: `up`, `enter`, or a printable character; others are passed over."""
    for key in _KEY.findall(typed):
        if key in _NAMES or key.isprintable():
            yield _NAMES.get(key, key)


class Line:
    """A line that is being typed."""

    def __init__(self, question: str, text: str, done: Callable[[str], None]) -> None:
        self.question, self.text, self.done = question, text, done
        self._at = len(text)

    def press(self, key: str) -> None:
        """One key but enter and escape."""
        before, after = self.text[: self._at], self.text[self._at :]
        if len(key) == 1:
            before += key
        elif key == "backspace":
            before = before[:-1]
        elif key == "delete":
            after = after[1:]
        elif key == "clear":
            before = after = ""
        self.text = before + after
        places = {"left": max(len(before) - 1, 0), "right": len(before) + 1, "home": 0, "end": len(self.text)}
        self._at = min(places.get(key, len(before)), len(self.text))

    def shown(self, width: int) -> Text:
        """As it looks, with its end or the place of typing in view."""
        text = Text.assemble((f"{self.question} ", "bold"), self.text, " ")
        place = len(self.question) + 1 + self._at
        text.stylize("reverse", place, place + 1)
        return text[max(0, place + 1 - width) :]


class TuneScreen:
    """See the module's text.

    Parameters
    ----------
    ask : has nodes take what a request wants; what came of it is told by `finished`
    title : where all of this is
    find : only what has this text in it is shown

    Attributes
    ----------
    ended : whether a key has ended it
    written : files, and how they are launched, of the last time that something was saved
    """

    def __init__(self, tuning: Tuning, ask: Callable[[Request], None], title: str, find: str = "") -> None:
        self.tuning, self._ask, self._title, self._find = tuning, ask, title, find
        self.ended, self.written = False, list[str]()
        self._chosen: Key = "", ""
        self._fixed = False
        self._said, self._ok = "looking for nodes", True
        self._line: Line | None = None
        self._text: list[str] = []  # in place of the table, until a key is pressed
        self._page, self._top = 10, 0

    # ---- what is told ----

    def say(self, text: str, ok: bool = True) -> None:
        """Show a message."""
        self._said, self._ok = text, ok

    def finished(self, request: Request, taken: set[Key], refusals: list[str]) -> None:
        """Nodes have taken these of the changes; why they have refused others."""
        self.tuning.finished(request, taken)
        told = [f"{name} = {value_text(self.tuning.now[node, name])}" for node, name in sorted(taken)]
        taken_in_words = f"in force: {', '.join(told)}" if told else "nothing changes"
        which = f" (set {self.tuning.chosen})" if request.way == "other set" else ""
        self.say(
            "; ".join([*refusals, *([taken_in_words + which] if told or not refusals else [])]), not refusals
        )

    # ---- keys ----

    def press(self, key: str) -> None:
        """One key of `keys_of`."""
        if self._text:
            self._text = []
        elif self._line is not None:
            self._press_in_line(self._line, key)
        else:
            self._press_in_table(key)

    def _press_in_line(self, line: Line, key: str) -> None:
        if key in ("enter", "escape"):
            self._line = None
            if key == "enter":
                self._trying(lambda: line.done(line.text))
            return
        line.press(key)

    def _press_in_table(self, key: str) -> None:
        keys = [setting_key(row) for row in self._rows() if isinstance(row, RuntimeSetting)]
        at = keys.index(self._chosen) if self._chosen in keys else 0
        steps = {"up": -1, "k": -1, "down": 1, "j": 1, "page up": -self._page, "page down": self._page}
        steps |= {"home": -len(keys), "end": len(keys)}
        acts: dict[str, Callable[[], None]] = {
            "u": lambda: self._ask(self.tuning.undo()),
            "r": lambda: self._ask(self.tuning.redo()),
            "s": lambda: self._ask(self.tuning.other_set()),
            "d": self._show_different,
            "w": lambda: self._type("folder or task file:", str(FOLDER), self._save),
            "/": lambda: self._type("find:", "", self._filter),
            "f": self._toggle_fixed,
            "?": lambda: self._show(HELP),
            "q": self._end,
        }
        if key in acts:
            self._trying(acts[key])
        elif keys and key in steps:
            self._chosen = keys[min(max(at + steps[key], 0), len(keys) - 1)]
        elif keys and key == "tab":
            later = (other for other in keys[at:] if other[0] != keys[at][0])
            self._chosen = next(later, keys[0])
        elif keys and key == "enter":
            self._edit(self.tuning.settings[keys[at]])

    def _trying(self, act: Callable[[], None]) -> None:
        try:
            act()
        except (SettingError, OSError) as error:
            self.say(str(error), ok=False)

    def _edit(self, setting: RuntimeSetting) -> None:
        key = setting_key(setting)
        if setting.fixed:
            self.say(f"{setting.name} cannot change while {setting.node} runs", ok=False)
            return
        now = self.tuning.now[key]
        text = now if isinstance(now, str) else value_text(now)

        def change(typed: str) -> None:
            if key not in self.tuning.settings:
                raise SettingError(f"{setting.node} is gone")
            request = self.tuning.change({key: setting.parsed(typed)})
            self.say(f"asking {setting.node}")
            self._ask(request)

        self._type(f"{setting.name}:", text, change)

    def _type(self, question: str, text: str, done: Callable[[str], None]) -> None:
        self._line = Line(question, text, done)

    def _filter(self, text: str) -> None:
        self._find = text.strip()
        self.say(f"those with '{self._find}' in them; / and an empty text shows all" if self._find else "all")

    def _toggle_fixed(self) -> None:
        self._fixed = not self._fixed

    def _end(self) -> None:
        self.ended = True

    def _save(self, text: str) -> None:
        self.written = saved(self.tuning, Path(text.strip()).expanduser())
        self._show(["written:", *self.written])

    def _show_different(self) -> None:
        lines = [
            f"{node} {name}: {value_text(start)} -> {value_text(now)}"
            for (node, name), (start, now) in sorted(self.tuning.different().items())
        ]
        self._show(["started with -> in force", *lines] if lines else ["all is as the nodes were started"])

    def _show(self, lines: list[str]) -> None:
        self._text = lines

    # ---- looks ----

    def _rows(self) -> list[RuntimeSetting | str]:
        """Settings that are shown, each node's below its name."""
        rows: list[RuntimeSetting | str] = []
        settings = sorted(self.tuning.settings.values(), key=lambda each: (each.node, each.order))
        for each in settings:
            if (each.fixed and not self._fixed) or self._find not in f"{each.node} {each.name}":
                continue
            if not any(isinstance(row, RuntimeSetting) and row.node == each.node for row in rows[-1:]):
                rows.append(each.node)
            rows.append(each)
        return rows

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The whole screen."""
        height = options.height or console.height
        rows = self._rows()
        settings = [row for row in rows if isinstance(row, RuntimeSetting)]
        if self._chosen not in map(setting_key, settings):
            self._chosen = setting_key(settings[0]) if settings else ("", "")
        nodes = len({each.node for each in settings})
        title = f"{self._title}: {len(settings)} settings of {nodes} nodes, set {self.tuning.chosen}"
        layout = Layout()
        layout.split_column(
            Layout(_text(title, "reverse"), size=1),
            Layout(self._body(rows, max(height - 2 - DETAILS - MESSAGE, 2)), name="body"),
            Layout(self._details(), size=DETAILS),
            Layout(_text(self._said, "bold" if self._ok else "bold red", no_wrap=False), size=MESSAGE),
            Layout(self._line.shown(options.max_width) if self._line else _text(SHORT, "dim"), size=1),
        )
        yield layout

    def _body(self, rows: list[RuntimeSetting | str], height: int) -> RenderableType:
        if self._text:
            return Text("\n").join(
                _text(line, no_wrap=False) for line in [*self._text, "", "(any key: back)"]
            )
        self._page = height - 1
        at = next((k for k, row in enumerate(rows) if not isinstance(row, str) and self._is_chosen(row)), 0)
        self._top = min(max(self._top, at + 1 - self._page), max(at - 1, 0))
        table = Table(box=None, expand=True, pad_edge=False, header_style="underline")
        for name in ("setting", "in force", "started with", "range"):
            least = NAME if name == "setting" else None
            table.add_column(name, ratio=1, min_width=least, no_wrap=True, overflow="ellipsis")
        for row in rows[self._top : self._top + self._page]:
            if isinstance(row, str):
                table.add_row(_text(row, "bold"))
                continue
            now, start = self.tuning.now[setting_key(row)], row.start
            style = "yellow" if now != start else "dim" if row.fixed else ""
            bounds = "fixed" if row.fixed else row.bounds.rpartition("; ")[2]
            cells = (f"  {row.name}", value_text(now), value_text(start), bounds)
            table.add_row(*map(_text, cells), style=f"{style} reverse" if self._is_chosen(row) else style)
        return table

    def _is_chosen(self, row: RuntimeSetting) -> bool:
        return setting_key(row) == self._chosen

    def _details(self) -> RenderableType:
        setting = self.tuning.settings.get(self._chosen)
        if setting is None or self._text:
            return Text(" ")  # rich takes an empty one for none
        now = self.tuning.now[self._chosen]
        can = "cannot change while its node runs" if setting.fixed else "changes at once"
        lines = (
            f"{setting.name} = {value_text(now)}; {can}",
            setting.doc if setting.bounds in setting.doc else f"{setting.doc}; {setting.bounds}",
        )
        return Text("\n").join(_text(line, no_wrap=False) for line in lines)


def setting_key(setting: RuntimeSetting) -> Key:
    """By which `Tuning` knows it."""
    return setting.node, setting.name


def _text(text: str, style: str = "", no_wrap: bool = True) -> Text:
    """A text of which nothing reaches the terminal as a command: strangers may have written it."""
    harmless = "".join(letter if letter.isprintable() else "?" for letter in text)
    return Text(harmless, style, no_wrap=no_wrap, overflow="ellipsis" if no_wrap else "fold")
