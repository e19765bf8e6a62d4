"""RecordingPage: the page for a recording: a time line with what happened on it, played, paused, sought."""

from __future__ import annotations

from html import escape
from typing import Any

from tactile_base.stamps import SECOND_NS
from tactile_records.bags.contents import Bag
from tactile_scene.scene import Scene
from tactile_scene.scene_file import SceneError, load_scene
from tactile_view.cell_state import CellState
from tactile_view.in_loop import handler
from tactile_view.page import Page
from tactile_view.recording import Recording
from tactile_view.repeats import CLOSE, Repeated, repeats
from tactile_view.words import set_html

SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
COLORS = {"phase": "#1e78dc", "refused": "#d2691e", "warning": "#c8a000", "diagnostics": "#c8a000",
          "parameter": "#7828c8", "stop": "#c01c1c", "arm": "#c01c1c"}  # fmt: skip
OTHER = "#888888"
MOST_LISTED, MOST_MARKS = 60, 1000  # events in words, places of the time line
CLOSE_PART = 0.02  # of a recording: what follows closer would be one mark
LASTING = "3px"  # how thick what lasts is drawn: other marks stay to be seen
MARKS_PERIOD = 1.0  # s


class RecordingPage(Page):
    """See the module's text."""

    source: Recording

    def __init__(
        self, recording: Recording, state: CellState, scene: Scene | None, host: str, port: int
    ) -> None:
        self._asked: list[tuple[str, Any]] = []
        super().__init__(state, recording, scene, host, port)

    def _build(self, scene: Scene | None) -> None:
        super()._build(scene)
        self.top.label = "Time"
        gui, recording = self.server.gui, self.source
        length = max(recording.duration, 1e-3)
        with self.top:
            self._marks = gui.add_html("")
            self._time: Any = gui.add_slider("s", 0.0, round(length, 2), 0.01, 0.0)
            row = gui.add_button_group("", ("play / pause", "◀ frame", "frame ▶"))
            self._paused = gui.add_html("")
            speed = gui.add_dropdown("speed", SPEEDS, initial_value="1")
            self._problem = gui.add_html("")
        with self.tabs.add_tab("Phases"):
            self._listed = gui.add_html("")
        self._time.on_update(handler(self._dragged))
        row.on_click(handler(lambda event: self._ask(event.target.value, None)))
        speed.on_update(handler(lambda event: setattr(recording, "speed", float(event.target.value))))

    def _dragged(self, event: Any) -> None:
        if event.client is not None:  # by a person, not by us
            self._ask("seek", event.target.value)

    def _ask(self, what: str, value: Any) -> None:
        """The next look at the recording does what elements ask for."""
        self._asked.append((what, value))

    def show(self) -> None:
        """See `Page`; what was asked for comes first, of several places sought the last."""
        recording = self.source
        while self._asked:
            what, value = self._asked.pop(0)
            if what == "seek":
                if not (self._asked and self._asked[0][0] == "seek"):
                    recording.seek(float(value))
            elif what == "play / pause":
                if recording.now_ns >= recording.end_ns:
                    recording.seek(0.0)
                recording.playing = not recording.playing
            else:
                recording.step(-1 if what.startswith("◀") else 1)
        super().show()
        set_html(self._paused, "" if recording.playing else "paused")
        if self._is_due("time line", MARKS_PERIOD):
            self._show_events()
        if self._time.max < recording.duration:
            self._time.max = round(recording.duration, 2)
        if abs(self._time.value - recording.seconds) > (0.1 if recording.playing else 5e-3):
            self._time.value = round(recording.seconds, 2)

    def _show_events(self) -> None:
        recording, length = self.source, max(self.source.duration, 1e-3)
        events = repeats(recording.events, max(CLOSE, CLOSE_PART * length))
        marks = timeline(events, recording.start_ns, length)
        if self._marks.content != marks:
            self._marks.content = marks
        part, left = recording.looked_through, len(events) - MOST_LISTED
        more = [f"{left} more"] if left > 0 else []
        more += [f"{part:.0%} of the recording looked through so far"] if part < 1.0 else []
        set_html(self._listed, "<br>".join([*listed(events[:MOST_LISTED], recording.start_ns), *more]))
        problem = f"<span style='color:#c01c1c'>{escape(recording.bag.problem)}</span>"
        set_html(self._problem, "still being written" if recording.growing else problem)


def timeline(events: list[Repeated], start_ns: int, length: float) -> str:
    """A bar with a mark where an event begins, at one place one of each kind, and a thin line as it lasts."""
    mark = (
        "<div title='{}' style='position:absolute;bottom:0;height:{};"
        "left:{:.2f}%;width:{};background:{}'></div>"
    )

    def place(ns: int) -> float:
        return round(MOST_MARKS * (ns - start_ns) / SECOND_NS / length) / MOST_MARKS * 100.0

    marks = {
        (place(event.first_ns), place(event.last_ns), event.kind): event.words for event in reversed(events)
    }  # of several at one place the first
    shown = ""
    for (first, last, kind), words in marks.items():
        title, color = escape(words, quote=True), COLORS.get(kind, OTHER)
        shown += mark.format(title, LASTING, first, f"{last - first:.2f}%", color) if last > first else ""
        shown += mark.format(title, "100%", first, "2px", color)
    kinds = sorted({event.kind for event in events})
    legend = " ".join(f"<span style='color:{COLORS.get(kind, OTHER)}'>{kind}</span>" for kind in kinds)
    bar = f"<div style='position:relative;height:14px;margin:0 0.6em;background:#eee'>{shown}</div>"
    return f"{bar}<div style='font-size:0.75em;padding:0 0.8em'>{legend}</div>"


def listed(events: list[Repeated], start_ns: int) -> list[str]:
    """Events in words, with their times."""

    def seconds(ns: int) -> str:
        return f"{(ns - start_ns) / SECOND_NS:.2f}"

    return [
        f"{seconds(event.first_ns)}{f' to {seconds(event.last_ns)}' if event.times > 1 else ''} s "
        f"{escape(event.words)}"
        for event in events
    ]


def scene_of_bag(bag: Bag) -> Scene | None:
    """The scene that a recording names, where its file is still here."""
    try:
        return load_scene(bag.note["scene_file"])
    except (KeyError, SceneError, OSError):
        return None
