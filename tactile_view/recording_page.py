"""RecordingPage: the page for a recording: a time line with what happened on it, played, paused, sought."""

from __future__ import annotations

from html import escape
from typing import Any

from tactile_base.stamps import SECOND_NS
from tactile_records.bags.contents import Bag
from tactile_scene.scene import Scene
from tactile_scene.scene_file import SceneError, load_scene
from tactile_view.cell_state import CellState, Event
from tactile_view.page import Page
from tactile_view.recording import Recording
from tactile_view.words import set_html

SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
COLORS = {"phase": "#1e78dc", "refused": "#d2691e", "warning": "#c8a000", "diagnostics": "#c8a000",
          "parameter": "#7828c8", "stop": "#c01c1c", "arm": "#c01c1c"}  # fmt: skip
OTHER = "#888888"
MOST_LISTED = 60


class RecordingPage(Page):
    """See the module's text."""

    source: Recording

    def __init__(
        self, recording: Recording, state: CellState, scene: Scene | None, host: str, port: int
    ) -> None:
        super().__init__(state, recording, scene, host, port)
        self.top.label = "Time"
        gui, length = self.server.gui, max(recording.duration, 1e-3)
        with self.top:
            self._marks = gui.add_html(timeline(recording.events, recording.start_ns, length))
            self._time: Any = gui.add_slider("s", 0.0, round(length, 2), 0.01, 0.0)
            row = gui.add_button_group("", ("play / pause", "◀ frame", "frame ▶"))
            self._paused = gui.add_html("")
            speed = gui.add_dropdown("speed", SPEEDS, initial_value="1")
            if recording.bag.problem:
                gui.add_html(f"<div style='color:#c01c1c'>{escape(recording.bag.problem)}</div>")
        with self.tabs.add_tab("Phases"):
            listed = gui.add_html("")
            set_html(listed, all_events(recording))
        self._opened = recording.playing = False
        self._asked: list[tuple[str, Any]] = []
        self._time.on_update(self._dragged)
        row.on_click(lambda event: self._ask(event.target.value, None))
        speed.on_update(lambda event: setattr(recording, "speed", float(event.target.value)))

    def _dragged(self, event: Any) -> None:
        if event.client is not None:  # by a person, not by us
            self._ask("seek", event.target.value)

    def _ask(self, what: str, value: Any) -> None:
        """Elements are handled in threads of their own; the loop does what they ask for."""
        self._asked.append((what, value))

    def show(self) -> None:
        """See `Page`; what was asked for comes first."""
        recording = self.source
        if not self._opened:  # it begins when somebody looks
            self._opened = recording.playing = True
        while self._asked:
            what, value = self._asked.pop(0)
            if what == "seek":
                recording.seek(float(value))
            elif what == "play / pause":
                if recording.now_ns >= recording.end_ns:
                    recording.seek(0.0)
                recording.playing = not recording.playing
            else:
                recording.step(-1 if what.startswith("◀") else 1)
        super().show()
        set_html(self._paused, "" if recording.playing else "paused")
        if abs(self._time.value - recording.seconds) > 0.1:
            self._time.value = round(recording.seconds, 2)


def timeline(events: list[Event], start_ns: int, length: float) -> str:
    """A bar with a mark for each event."""
    mark = (
        "<div title='{}' style='position:absolute;top:0;height:100%;width:2px;"
        "left:{:.2f}%;background:{}'></div>"
    )
    marks = "".join(
        mark.format(
            escape(event.text, quote=True),
            100.0 * (event.stamp_ns - start_ns) / SECOND_NS / length,
            COLORS.get(event.kind, OTHER),
        )
        for event in events
    )
    kinds = sorted({event.kind for event in events})
    legend = " ".join(f"<span style='color:{COLORS.get(kind, OTHER)}'>{kind}</span>" for kind in kinds)
    bar = f"<div style='position:relative;height:14px;margin:0 0.6em;background:#eee'>{marks}</div>"
    return f"{bar}<div style='font-size:0.75em;padding:0 0.8em'>{legend}</div>"


def all_events(recording: Recording) -> str:
    """The events of the whole recording with their times."""
    return "<br>".join(
        f"{(event.stamp_ns - recording.start_ns) / SECOND_NS:.2f} s {event.kind}: {escape(event.text)}"
        for event in recording.events[:MOST_LISTED]
    )


def scene_of_bag(bag: Bag) -> Scene | None:
    """The scene that a recording names, where its file is still here."""
    try:
        return load_scene(bag.note["scene_file"])
    except (KeyError, SceneError, OSError):
        return None
