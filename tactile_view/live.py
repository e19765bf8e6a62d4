"""LiveGraph: hears what the arms of a ROS domain say, for the page."""

from __future__ import annotations

import time
from typing import Any

from tactile_base import topics
from tactile_base.node_topics import VIEW
from tactile_base.topics import LATCHED, Topic
from tactile_bringup.launching.graph_client import GraphClient
from tactile_bringup.launching.operator import Operator, OperatorError
from tactile_ros.conversions import message_class
from tactile_ros.qos import DIAGNOSTICS, IMAGE, LOOKING, NOTES, TF_STATIC
from tactile_view.cell_state import CellState, shown_topics
from tactile_wire.message_definitions import installed_typestore

LOOK = 1.0  # s, between looks for arms that are new
KEPT = 5.0  # s, that it goes on after the last page was closed: it may be loaded anew
ALWAYS = (topics.DIAGNOSTICS, topics.ROSOUT, topics.PARAMETER_EVENTS, topics.ESTOP)  # little, and told once
SHARED = (topics.TF, topics.TF_STATIC)
_PROFILES = {
    topics.TF_STATIC.name: TF_STATIC,
    topics.DIAGNOSTICS.name: DIAGNOSTICS,
    topics.ROSOUT.name: NOTES,
    topics.PARAMETER_EVENTS.name: DIAGNOSTICS,
    topics.ESTOP.name: DIAGNOSTICS,
}
IMAGE_RATE = 10.0  # Hz, at which images are taken: others are not even copied


class LiveGraph(GraphClient):
    """Gives each message that arrives to a `CellState`; a context, as `GraphClient`.

    What arms say many times a second is heard only while somebody looks: else no byte of it comes here.
    """

    types = staticmethod(installed_typestore)

    def __init__(self, domain_id: int, state: CellState) -> None:
        super().__init__(VIEW, domain_id)
        self._state, self._heard, self._found_at, self._looked_at = state, dict[str, Any](), -LOOK, -KEPT
        for topic in ALWAYS:
            self._listen(topic)

    def poll(self, timeout_s: float, looked_at: bool) -> None:
        """Handle what arrives within so long; while somebody looks, listen also to arms that are new."""
        now = time.monotonic()
        if looked_at:
            self._looked_at = now
            if now - self._found_at > LOOK:
                self._found_at = now
                self._hear_arms()
        elif self._heard and now - self._looked_at > KEPT:
            self._hear_no_arm()
        while (left := now + timeout_s - time.monotonic()) > 0.0:
            self.spin(left)

    def _hear_arms(self) -> None:
        names = [name for name, _ in self._node.get_topic_names_and_types()]
        arms = filter(None, map(topics.ARM_STATUS.arm_of, names))
        for topic in (*SHARED, *(topic for arm in arms for topic in shown_topics(arm))):
            if topic.name not in self._heard:
                self._heard[topic.name] = self._listen(topic)

    def _hear_no_arm(self) -> None:
        for subscription in self._heard.values():
            self._node.destroy_subscription(subscription)
        self._heard.clear()
        self._state.arms.clear()  # it would be old when somebody looks again
        self._found_at = -LOOK

    def _listen(self, topic: Topic) -> Any:
        name, kind, due = topic.name, topic.type, 0.0
        is_image = topics.IMAGE.arm_of(name) is not None

        def take(data: bytes) -> None:
            nonlocal due
            if is_image:
                if (now := time.monotonic()) < due:
                    return
                due = now + 1.0 / IMAGE_RATE
            self._state.take(name, kind, data, time.time_ns())

        profile = _PROFILES.get(name, LOOKING)
        profile = IMAGE if is_image else NOTES if topic.qos == LATCHED and name not in _PROFILES else profile
        return self._node.create_subscription(message_class(kind), name, take, profile, raw=True)


def scene_of(operator: Operator) -> str:
    """Path of the scene of the graph, as the node of an arm or the simulation says; '': none does."""
    for node in sorted(operator.node_names()):
        if node.endswith("/arm") or node == "/sim":
            try:
                value = operator.parameters(node).get("scene", ("", None))[0]
            except OperatorError:
                continue
            if value:
                return str(value)
    return ""
