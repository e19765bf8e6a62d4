"""`tactile foxglove`: the topics of a running graph for Foxglove and Lichtblick, over their web socket.

Messages go through as the graph has them, CDR with the definition of their type, and only those of topics
that somebody looks at are heard at all. Nothing can be sent the other way.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import foxglove

from tactile_bringup.launching.graph_client import GraphClient
from tactile_ros.conversions import message_class
from tactile_ros.qos import TF_STATIC, viewer_profile
from tactile_wire.errors import DefinitionDamaged, DefinitionMissing
from tactile_wire.message_definitions import message_definition

if TYPE_CHECKING:
    from foxglove.websocket import ServerListener

LOOK = 1.0  # s, between looks for topics that are new
BACKLOG = 256  # messages that wait for a slow client; older ones are dropped


class FoxgloveBridge(GraphClient):
    """See the module's text; a context, as `GraphClient`."""

    def __init__(self, domain_id: int, host: str, port: int) -> None:
        super().__init__("/tactile_foxglove", domain_id)
        foxglove.set_log_level("CRITICAL")  # it has a line for each message to a client that has just gone
        self._context_of_channels = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._types: dict[str, str] = {}
        self._heard: dict[str, Any] = {}
        self._readers: dict[str, int] = {}
        self._news: queue.Queue[tuple[str, int]] = queue.Queue()  # from the server's thread
        self._looked = -LOOK
        self.server = foxglove.start_server(
            name="tactile_servoing", host=host, port=port, server_listener=cast("ServerListener", self),
            context=self._context_of_channels, message_backlog_size=BACKLOG,
        )  # fmt: skip

    def run(self, ends: Callable[[], bool]) -> None:
        """Serve until it `ends`."""
        while not ends():
            if time.monotonic() - self._looked > LOOK:
                self._looked = time.monotonic()
                self._look()
            while not self._news.empty():
                self._count(*self._news.get())
            self.spin(0.05)

    def close(self) -> None:
        """See `GraphClient`."""
        self.server.stop()
        super().close()

    # ---- what clients of the server want; called in a thread of the server's ----

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Somebody looks at a topic."""
        self._news.put((channel.topic, 1))

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Somebody looks no more."""
        self._news.put((channel.topic, -1))

    # ---- topics ----

    def _look(self) -> None:
        """Offer topics that are new and whose type is known."""
        for topic, types in self._node.get_topic_names_and_types():
            if topic in self._types or not types:
                continue
            self._types[topic] = types[0]
            try:
                text = message_definition(types[0])
            except (DefinitionMissing, DefinitionDamaged):
                continue  # nobody could read it
            schema = foxglove.Schema(name=types[0], encoding="ros2msg", data=text.encode())
            self._channels[topic] = foxglove.Channel(
                topic, schema=schema, message_encoding="cdr", context=self._context_of_channels
            )

    def _count(self, topic: str, more: int) -> None:
        """Hear a topic while it has readers, and one that is said once anew for each of them."""
        self._readers[topic] = self._readers.get(topic, 0) + more
        heard = self._heard.get(topic)
        latched = heard is not None and heard.qos_profile.durability == TF_STATIC.durability
        if heard is not None and (self._readers[topic] <= 0 or (more > 0 and latched)):
            self._node.destroy_subscription(self._heard.pop(topic))
        if self._readers[topic] > 0 and topic not in self._heard:
            self._heard[topic] = self._node.create_subscription(
                message_class(self._types[topic]),
                topic,
                self._channels[topic].log,
                viewer_profile(self._node.get_publishers_info_by_topic(topic)),
                raw=True,
            )
