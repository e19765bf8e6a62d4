"""LivePage: the page beside a running graph: what arms do, and buttons and settings to act on them."""

from __future__ import annotations

import threading
from html import escape

from tactile_bringup.launching.hands import Hands, carry_out, settings_of
from tactile_bringup.launching.operator import Operator, OperatorError
from tactile_bringup.tuning import Request
from tactile_scene.scene import Scene
from tactile_scene.scene_file import SceneError, load_scene
from tactile_view.cell_state import CellState
from tactile_view.in_loop import handler, later
from tactile_view.live import LiveGraph, scene_of
from tactile_view.page import Page
from tactile_view.settings_panel import SettingsPanel
from tactile_view.words import set_html

NODES = ("controller", "filter", "estimator", "arm")
NO_EMERGENCY_STOP = "These buttons are software. They are no emergency stop: keep the real one at hand."
FIND, TRIES = 3.0, 10  # s, to find what is there; and how often


class LivePage(Page):
    """See the module's text; `graph` gives the messages, `hands` does what is asked for.

    With `read_only` there is no element that acts, so that no message to the page can.
    """

    source: LiveGraph

    def __init__(
        self, graph: LiveGraph, state: CellState, host: str, port: int, read_only: bool = False
    ) -> None:
        self.hands = Hands(Operator(graph.domain_id, looks=False), self._say)
        self._domain_id, self._node, self._read_only = graph.domain_id, "", read_only
        self._scene: Scene | None = None  # once it is known, until it is shown
        self._tries = TRIES
        super().__init__(state, graph, None, host, port)
        self.hands.ask(self._find_scene)

    def _build(self, scene: Scene | None) -> None:
        super()._build(scene)
        if self._read_only:
            with self.top:
                self._said = self.server.gui.add_html("")
        else:
            self._build_acts()
            with self.tabs.add_tab("Settings"):
                self._nodes = self.server.gui.add_dropdown("node", NODES)
                self._nodes.on_update(handler(lambda event: self._load_settings()))
                self._settings = SettingsPanel(self.server, self._set)

    def close(self) -> None:
        """Let go of graph and page."""
        self.hands.close()
        super().close()
        self.source.close()

    def _find_scene(self, operator: Operator) -> str:
        """Which scene the graph has, as its nodes say, where its file is on this machine."""
        operator.find(FIND, lambda: any(name.endswith("/arm") for name in operator.node_names()))
        path, self._tries = scene_of(operator), self._tries - 1
        try:
            self._scene = load_scene(path) if path else None
        except (SceneError, OSError) as error:
            return f"bodies are not shown: {error}"
        if self._scene is None and self._tries:
            self.hands.ask(self._find_scene)
        return f"scene {self._scene.name}" if self._scene else "no node says which scene it has: no bodies"

    # ---- acts ----

    def _build_acts(self) -> None:
        gui = self.server.gui
        with self.top:
            stop = gui.add_button("STOP all arms", color="red")
            stop.on_click(handler(lambda event: self._stop()))
            gui.add_html(f"<div style='font-size:0.8em;padding:0 0.5em'>{NO_EMERGENCY_STOP}</div>")
            row = gui.add_button_group("", ("reset", "end goal"))
            row.on_click(handler(lambda event: self._act(event.target.value)))
            self._goal = gui.add_text(
                "goal", "{}", hint="values of the task's goal as YAML, e.g. {length: 0.05}"
            )
            start = gui.add_button("start goal")
            start.on_click(handler(lambda event: self._start()))
            self._said = gui.add_html("")

    def _say(self, text: str, ok: bool) -> None:
        color = "inherit" if ok else "#c01c1c"
        said = f"<span style='color:{color}'>{escape(text)}</span>"
        later(self.server, lambda: set_html(self._said, said))

    def _stop(self) -> None:
        self.hands.stop_all()
        self._say("all arms were told to stop; reset lets them move again", True)

    def _act(self, what: str) -> None:
        arm = self.arm

        def act(operator: Operator) -> str:
            if what == "reset":
                return f"{arm}: {operator.reset(arm)}"
            count = operator.cancel(arm)
            return f"{arm}: {'its goal ends' if count else 'no goal runs'}"

        self.hands.ask(act)

    def _start(self) -> None:
        """Run a goal in a thread of its own, since it takes as long as the task."""
        state = self.state.arms.get(self.arm)
        if state is None or state.controller is None:
            self._say(f"{self.arm} has no controller that takes goals", False)
            return
        words = {"task": state.controller.task, "name": "from the page", "goal": self._goal.value}
        threading.Thread(target=self._run_goal, args=(self.arm, words), daemon=True).start()

    def _run_goal(self, arm: str, words: dict[str, str]) -> None:
        self._say(f"{arm}: {words['task']} is asked for", True)
        try:
            with Operator(self._domain_id) as operator:
                result = operator.run_goal(arm, words, lambda feedback: None, lambda: False)
        except OperatorError as error:
            self._say(f"{arm}: {error}", False)
            return
        way = f"{1e3 * result.path_length:.0f} mm"
        self._say(f"{arm}: {'done' if result.success else 'failed: ' + result.reason}, {way}", result.success)

    # ---- settings ----

    def show(self) -> None:
        """See `Page`; the settings are those of the arm that is looked at."""
        if self._scene is not None:
            self.view.set_scene(self._scene)
            self._scene = None
        super().show()
        if self._read_only:
            return
        node = f"/{self.arm}/{self._nodes.value}"
        if self.arm in self.state.arms and node != self._node:
            self._load_settings()
        for changed in list(self.state.changed):
            for name, value in self.state.changed.pop(changed, {}).items():
                self._settings.heard(changed, name, value)

    def _load_settings(self) -> None:
        self._node = node = f"/{self.arm}/{self._nodes.value}"

        def act(operator: Operator) -> str:
            found = settings_of(operator, node)
            later(self.server, lambda: self._settings.fill(node, found))
            return f"{node}: {len(found)} parameters"

        self.hands.ask(act)

    def _set(self, request: Request) -> None:
        def act(operator: Operator) -> str:
            taken, refusals = carry_out(operator, request)
            later(self.server, lambda: self._settings.finished(request, taken, refusals))
            if refusals:
                raise OperatorError("; ".join(refusals))
            return ", ".join(f"{node} {name}" for node, name in taken) + " changed"

        self.hands.ask(act)
