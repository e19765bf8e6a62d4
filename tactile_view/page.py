"""The page: what stands where, and the loop that brings it up to date while somebody looks."""

from __future__ import annotations

import contextlib
import functools
import io
import time
from collections.abc import Callable
from html import escape
from typing import Any, Protocol

import viser

from tactile_bringup.launching.page_process import free_port
from tactile_scene.scene import Scene
from tactile_view.cell_state import CellState
from tactile_view.cell_view import CellView
from tactile_view.door import only_own_pages, token_for
from tactile_view.follower import CameraFollower
from tactile_view.in_loop import handler, wait_for
from tactile_view.panels import BeliefPanel, MotionPanel, TouchPanel
from tactile_view.words import (
    events_in_words,
    other_in_words,
    overload_in_words,
    set_html,
    state_in_words,
    troubles_in_words,
)

SCENE_PERIOD, PLOT_PERIOD, WORDS_PERIOD, TOUCH_PERIOD = 0.06, 0.25, 0.25, 0.12  # s, between two looks at it
ENDED = "<b>This page has ended</b>, as has its run. <i>tactile view BAG</i> shows a recording."
LAST_WORD = 0.3  # s, for it to arrive
POLL, IDLE = 0.02, 0.2  # s, while somebody looks and while nobody does


class Source(Protocol):
    """Where messages come from: a graph or a recording."""

    def types(self, type_name: str) -> Any:
        """What `rosbags` reads messages of a type with."""

    def poll(self, timeout_s: float, looked_at: bool) -> None:
        """Give what comes within so long to the cell's state; while nobody looks, no more than has to be."""


class Page:
    """See the module's text.

    Parameters
    ----------
    host, port : where the page is served, the next port that is free or with 0 any; a `host` other than this
        one lets others look, and touch, who have the token in `address`
    scene : what stands in the cell; None where nobody knows
    """

    def __init__(self, state: CellState, source: Source, scene: Scene | None, host: str, port: int) -> None:
        self.state, self.source, self._token = state, source, token_for(host)
        with (
            only_own_pages(host, self._token),
            contextlib.redirect_stdout(io.StringIO()),
        ):  # we say ourselves where it is
            self.server = viser.ViserServer(
                host=host, port=port or free_port(host), label="tactile_servoing", verbose=False
            )
        self.arm = ""
        self._due: dict[str, float] = {}
        wait_for(self.server, lambda: self._build(scene))

    @property
    def address(self) -> str:
        """What to open in a browser."""
        token = f"/?token={self._token}" if self._token else ""
        return f"http://{self.server.get_host()}:{self.server.get_port()}{token}"

    def _build(self, scene: Scene | None) -> None:
        gui = self.server.gui
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self.view = CellView(self.server, scene)
        self._words = gui.add_html("<p>nothing heard yet</p>")
        self.top = gui.add_folder("Do")
        self._arms = gui.add_dropdown("arm", ("-",), visible=False)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Touch"):
            self._touch = TouchPanel(self.server, self.source.types)
        with tabs.add_tab("Belief"):
            self._belief = BeliefPanel(self.server)
        with tabs.add_tab("Motion"):
            self._motion = MotionPanel(self.server)
        with tabs.add_tab("Events"):
            self._troubles = gui.add_html("")
            self._events = gui.add_html("")
        with tabs.add_tab("Look"):
            self._build_look()
        self.tabs = tabs

    def _build_look(self) -> None:
        gui, options = self.server.gui, self.view.options
        shown = (
            ("truth", "truth of the simulation"), ("path", "path"), ("twist", "twist"),
            ("friction", "shear at which a simulated skin slides"),
        )  # fmt: skip
        for name, label in shown:
            box: Any = gui.add_checkbox(label, getattr(options, name))
            box.on_update(handler(functools.partial(self._choose, name)))
        size = gui.add_slider("uncertainty, times", 1.0, 50.0, 1.0, options.uncertainty)
        size.on_update(handler(lambda event: setattr(options, "uncertainty", event.target.value)))
        self.follow = gui.add_checkbox("camera follows the tip", True)
        self._followers: dict[int, CameraFollower] = {}  # of each page

    def _choose(self, name: str, event: Any) -> None:
        setattr(self.view.options, name, event.target.value)

    def close(self) -> None:
        """Serve no more."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    # ---- the loop ----

    def run(self, ends: Callable[[], bool]) -> None:
        """Show what comes until it `ends`."""
        while not ends():
            looked_at = bool(self.server.get_clients())
            self.source.poll(POLL if looked_at else IDLE, looked_at)
            if looked_at:
                wait_for(self.server, self.show)

    def show(self) -> None:
        """Bring up to date what is due; in the server's loop, as all that changes elements."""
        arms = tuple(sorted(self.state.arms)) or ("-",)
        if self._arms.options != arms:
            self._arms.options, self._arms.visible = arms, len(arms) > 1
        self.arm = self._arms.value if self._arms.value in self.state.arms else arms[0]
        state = self.state.arms.get(self.arm)
        if self._is_due("scene", SCENE_PERIOD):
            self.view.show(self.state)
            self._follow()
        if state is None:
            return
        if self._is_due("touch", TOUCH_PERIOD):
            self._touch.show(state)
        if self._is_due("plots", PLOT_PERIOD):
            self._belief.show(state, self.state.now_ns)
            self._motion.show(state, self.state.now_ns)
        if self._is_due("words", WORDS_PERIOD):
            set_html(self._words, self._state_in_words())
            set_html(self._troubles, troubles_in_words(self.state, self.view.remarks))
            set_html(self._events, events_in_words(self.state))

    def _state_in_words(self) -> str:
        """Whether the machine is overloaded; of the arm that is looked at all, of the others what they do."""
        state = self.state.arms[self.arm]
        words = state_in_words(state, self.view.skin(self.arm))
        others = [each for name, each in sorted(self.state.arms.items()) if name != self.arm]
        lines = [f"<b>{escape(self.arm)}</b>", words, *map(other_in_words, others)] if others else [words]
        return "<br>".join(filter(None, [overload_in_words(self.state), *lines]))

    def say_end(self) -> None:
        """Leave a word on the page, which stays as it is when nobody serves it any more."""
        wait_for(self.server, lambda: set_html(self._words, ENDED))
        time.sleep(LAST_WORD)

    def _is_due(self, what: str, period: float) -> bool:
        now = time.monotonic()
        due = now >= self._due.get(what, 0.0)
        if due:
            self._due[what] = now + period
        return due

    def _follow(self) -> None:
        """Have each new page look at the tips, and move its camera as they move."""
        tips = self.view.tips(self.state)
        if not tips:
            return
        for number, client in self.server.get_clients().items():
            if client.camera.update_timestamp == 0.0:
                continue  # it has yet to say where it looks from
            follower = self._followers.setdefault(number, CameraFollower())
            with client.atomic():
                follower.step(client.camera, tips, self.follow.value)
