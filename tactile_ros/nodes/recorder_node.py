"""Recorder node: writes topics as they come, without decoding them, into a bag that survives a kill.

Images are recorded only where `images` names their topics: compressed without loss (PNG), as
sensor_msgs/CompressedImage on `<topic>/compressed`, since raw ones at 60 Hz are 18 MB a second.

Being held up for 30 s costs no message of the reliable topics that our nodes publish. Messages that are lost
all the same are counted, by topic, in /diagnostics and, as `messages_lost`, in the bag's note.
"""

from __future__ import annotations

import importlib
import json
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage, Image

from tactile_base.topics import COMMAND, IMAGE, QOS_KINDS, Topic, compressed
from tactile_records.bags.message_definitions import DefinitionMissing
from tactile_records.bags.writer import BagError, BagWriter
from tactile_ros.conversions import MessageError, array_from_image
from tactile_ros.managed_node import ConfigurationError, ManagedNode, lost_counter, run
from tactile_ros.parameters import declare_read_only
from tactile_ros.qos import recorder_profile

FLUSH_PERIOD = 0.5  # s; a kill costs at most this much of the recording
PNG_FAST = [cv2.IMWRITE_PNG_COMPRESSION, 1]


class RecorderNode(ManagedNode):
    """See the module's text. It records from configuration on: nothing of the others' start is missed."""

    def __init__(self) -> None:
        super().__init__("recorder")
        self.folder = Path(declare_read_only(self, "bag", "", "folder of the new bag"))
        listed = declare_read_only(self, "topics", [""], "topics to record, each as 'NAME TYPE QOS'")
        images = declare_read_only(self, "images", [""], "image topics to record compressed")
        note = declare_read_only(self, "note", [""], "what to keep with the bag, each as 'NAME=TEXT'")
        self.topics = [_topic(text) for text in listed if text]
        self.images = [name for name in images if name]
        self.note = dict(text.split("=", 1) for text in note if text)
        self.bag: BagWriter | None = None
        self.lost: Counter[str] = Counter()
        self.open: list[tuple[Any, Callable[[Any], None]]] = []

    def configure(self) -> None:
        """Create the bag and subscribe."""
        if self.folder == Path():
            raise ConfigurationError("parameter bag: must name the folder of the new bag")
        packed = [compressed(Topic(name, IMAGE.type, IMAGE.qos)) for name in self.images]
        try:
            self.bag = BagWriter(self.folder, [*self.topics, *packed], note=self.note)
        except (BagError, DefinitionMissing, OSError) as error:
            raise ConfigurationError(str(error)) from error
        for topic in self.topics:
            self._record(topic)
        for name in self.images:
            self._record_images(name)
        flush = self.create_timer(FLUSH_PERIOD, self._flush, clock=self.steady)
        self.release_later(self.destroy_timer, flush)
        self.report.values["bag"] = str(self.folder)

    def cleanup(self) -> None:
        """Write what has arrived by now, and finish the bag."""
        for subscription, write in self.open:
            with subscription.handle:
                while taken := subscription.handle.take_message(subscription.msg_type, subscription.raw):
                    write(taken[0])
        self.open.clear()
        if self.bag is not None:
            self.bag.close()
            lost = f", {self.lost.total()} lost" if self.lost else ""
            self.get_logger().info(f"{self.counters['messages']} messages in {self.folder}{lost}")
            self.bag = None

    def command_topics(self) -> list[str]:
        """Those that are recorded: the bag holds how the arms came to rest."""
        return [topic.name for topic in self.topics if COMMAND.arm_of(topic.name)]

    def _record(self, topic: Topic) -> None:
        # Without MessageInfo, whose time of publication would be welcome: the events executor cannot pass it.
        def write(data: Any) -> None:
            self._write(topic.name, data)

        self._listen(topic, _message_type(topic.type), write, raw=True)

    def _record_images(self, name: str) -> None:
        def write(message: Image) -> None:
            try:
                data = cv2.imencode(".png", array_from_image(message), PNG_FAST)[1].tobytes()
            except MessageError as error:
                self.count("images refused")
                self.warn("image", f"{name} refused: {error}")
                return
            packed = CompressedImage(header=message.header, format=f"{message.encoding}; png", data=data)
            self._write(f"{name}/compressed", serialize_message(packed))

        self._listen(Topic(name, IMAGE.type, IMAGE.qos), Image, write, raw=False)

    def _listen(self, topic: Topic, message_type: Any, write: Callable[[Any], None], raw: bool) -> None:
        def lose(info: Any) -> None:
            self.lost[topic.name] += info.total_count_change
            self.count(lost_counter(topic.name), info.total_count_change)
            self.warn(f"{topic.name} lost", f"{topic.name}: {self.lost[topic.name]} messages lost so far")
            if self.bag is not None:
                self.bag.note["messages_lost"] = json.dumps(self.lost)

        events = SubscriptionEventCallbacks(message_lost=lose)
        subscription: Any = self.create_subscription(
            message_type, topic.name, write, recorder_profile(topic), event_callbacks=events, raw=raw
        )
        self.open.append((subscription, write))
        self.release_later(self.destroy_subscription, subscription)

    def _write(self, topic: str, data: bytes) -> None:
        if self.bag is not None:
            self.count("messages")
            self.bag.write(topic, data, self.now_ns())

    def _flush(self) -> None:
        if self.bag is not None:
            self.bag.flush()


def _topic(text: str) -> Topic:
    parts = text.split()
    if len(parts) != 3 or parts[2] not in QOS_KINDS:
        kinds = ", ".join(QOS_KINDS)
        raise ConfigurationError(f"topics: '{text}': must be 'NAME TYPE QOS' with a QOS of {kinds}")
    return Topic(*parts)


def _message_type(name: str) -> Any:
    """The class of `package/msg/Name`; raises ConfigurationError where package or message is missing."""
    package, _, message = name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), message)
    except (ImportError, AttributeError) as error:
        raise ConfigurationError(f"topics: no message {name}: {error}") from error


def main() -> int:
    """Run the node until a signal; returns the exit code."""
    return run(RecorderNode)


if __name__ == "__main__":
    sys.exit(main())
