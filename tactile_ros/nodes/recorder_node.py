"""Recorder node: writes topics as they come, without decoding them, into a bag that survives a kill.

Images are recorded only where `images` names their topics: compressed without loss (PNG), as
sensor_msgs/CompressedImage on `<topic>/compressed`, since raw ones at 60 Hz are 18 MB a second.

Being held up for 30 s costs no message of the reliable topics that our nodes publish (docs/replay.md). What
is lost all the same shows in the numbers that publishers give their messages: it is told with topic, number
and time in the log, in /diagnostics and in the bag. No number tells what a publisher sent last, if it ended
while the recorder was held up: then the bag says from when on messages may be missing.
"""

from __future__ import annotations

import inspect
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage, Image

from tactile_base.stamps import SECOND_NS
from tactile_base.topics import COMMAND, IMAGE, LATCHED, QOS_KINDS, Topic, compressed
from tactile_perception.estimating.encodings import encoding_of
from tactile_records.bags.contents import Gap
from tactile_records.bags.losses import Losses
from tactile_records.bags.writer import BagError, BagWriter
from tactile_ros.conversions import array_from_image, message_class
from tactile_ros.managed_node import ConfigurationError, ManagedNode, lost_counter, refused_counter
from tactile_ros.parameters import declare_read_only
from tactile_ros.qos import recorder_profile
from tactile_ros.run_nodes import run
from tactile_wire.errors import DefinitionMissing, MessageError

FLUSH_PERIOD = 0.5  # s; a kill costs at most this much of the recording
HELD_UP = 1.0  # s longer than that without anything to do: the recorder was held up
QUIET, CATCH_UP = 1.0, 4.0  # s; at the end it waits for what is on its way until none comes, but no longer
LARGEST = 1 << 22  # bytes of a message; the surfaces of a scene have 1 MB
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
        self.losses = Losses()
        self.told: Counter[str] = Counter()  # by topic, what the middleware says to have lost
        self.busy = 0.0  # when it last had something to do (s, steady)
        self.open: list[tuple[Any, _Taker]] = []

    def configure(self) -> None:
        """Create the bag and subscribe."""
        if self.folder == Path():
            raise ConfigurationError("parameter bag: must name the folder of the new bag")
        packed = [compressed(Topic(name, IMAGE.type, IMAGE.qos)) for name in self.images]
        try:
            self.bag = BagWriter(self.folder, [*self.topics, *packed], note=self.note)
        except (BagError, DefinitionMissing) as error:
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
        self._look_at_the_clock()
        self._catch_up()
        self.open.clear()
        for gap in self.losses.last(self.told, time.time_ns()):
            self._lose(gap)
        if self._try(BagWriter.close):
            total = self.losses.lost.total()
            lost = f", {total} lost" if total else ""
            self.get_logger().info(f"{self.counters['messages']} messages in {self.folder}{lost}")
        self.bag = None

    def _catch_up(self) -> None:
        """Take what has arrived, and after a delay what is still on its way."""
        started = heard = time.monotonic()
        while True:
            before = self.counters["messages"]
            for subscription, take in self.open:
                with subscription.handle:
                    while taken := subscription.handle.take_message(subscription.msg_type, subscription.raw):
                        take(*taken)
            now = time.monotonic()
            heard = now if self.counters["messages"] > before else heard
            if not self.losses.late or now - heard > QUIET:
                return
            if now - started > CATCH_UP:
                for gap in self.losses.on_their_way(time.time_ns()):
                    self._lose(gap)
                return
            time.sleep(0.01)

    def command_topics(self) -> list[str]:
        """Those that are recorded: the bag holds how the arms came to rest."""
        return [topic.name for topic in self.topics if COMMAND.arm_of(topic.name)]

    def _record(self, topic: Topic) -> None:
        def write(data: Any, published_ns: int) -> None:
            if len(data) > LARGEST:
                self.count(refused_counter(topic.name))
                self.warn(f"{topic.name} refused", f"{topic.name} refused: {len(data)} bytes are too many")
                return
            self._write(topic.name, data, published_ns)

        message_type = message_class(topic.type)
        if message_type is None:
            raise ConfigurationError(f"topics: no message {topic.type}: its package is not installed")
        self._listen(topic, message_type, write, raw=True)

    def _record_images(self, name: str) -> None:
        def write(message: Image, published_ns: int) -> None:
            try:
                image = array_from_image(message, color=True)
                data = cv2.imencode(".png", image, PNG_FAST)[1].tobytes()
            except MessageError as error:
                self.count("images refused")
                self.warn("image", f"{name} refused: {error}")
                return
            packed = CompressedImage(header=message.header, format=f"{encoding_of(image)}; png", data=data)
            self._write(f"{name}/compressed", serialize_message(packed), published_ns)

        self._listen(Topic(name, IMAGE.type, IMAGE.qos), Image, write, raw=False)

    def _listen(self, topic: Topic, message_type: Any, write: Callable[[Any, int], None], raw: bool) -> None:
        def take(message: Any, info: Any) -> None:
            self._look_for_gap(topic, info)
            write(message, info["source_timestamp"])

        def lose(info: Any) -> None:
            self.told[topic.name] += info.total_count_change

        events = SubscriptionEventCallbacks(message_lost=lose)
        taker = _Taker(take)
        subscription: Any = self.create_subscription(
            message_type, topic.name, taker, recorder_profile(topic), event_callbacks=events, raw=raw
        )
        self.open.append((subscription, taker))
        self.release_later(self.destroy_subscription, subscription)

    def _look_for_gap(self, topic: Topic, info: Any) -> None:
        """Look at a message's number, where the middleware passes it on."""
        self._look_at_the_clock()
        number, publisher = info.get("publication_sequence_number"), info.get("publisher_gid")
        published_ns = info["source_timestamp"]
        if topic.qos != LATCHED:  # those come late to who comes late
            self.losses.delay(topic.name, time.time_ns() - published_ns)
        if number is not None and publisher is not None:
            gap = self.losses.seen(topic.name, publisher["data"], number, published_ns)
            if gap is not None:
                self._lose(gap)

    def _look_at_the_clock(self) -> None:
        """Whether the recorder was held up: it has something to do at least once a `FLUSH_PERIOD`."""
        now = time.monotonic()
        delay = now - self.busy - FLUSH_PERIOD
        if self.busy and delay > HELD_UP:
            now_ns = time.time_ns()
            self.losses.held_up(now_ns - round((now - self.busy) * SECOND_NS), now_ns)
            self.count("times held up")
            self.warn("held up", f"held up for {delay:.1f} s")
        self.busy = now

    def _lose(self, gap: Gap) -> None:
        self.count(lost_counter(gap.topic), gap.messages)
        known = self.losses.lost[gap.topic]
        self.warn(f"{gap.topic} lost", f"{gap}; {known} messages known to be lost so far")
        self._try(lambda bag: bag.add_gap(gap))

    def _write(self, topic: str, data: bytes, published_ns: int) -> None:
        if self._try(lambda bag: bag.write(topic, data, self.now_ns(), published_ns)):
            self.count("messages")

    def _flush(self) -> None:
        self._look_at_the_clock()
        now_ns = time.time_ns()
        for topic in self.losses.in_doubt(now_ns):
            found = self.get_publishers_info_by_topic(topic)
            self.losses.present(topic, {bytes(info.endpoint_gid) for info in found}, now_ns)
        self._try(BagWriter.flush)

    def _try(self, act: Callable[[BagWriter], None]) -> bool:
        """Do something with the bag, if there is one; once it cannot be written, the recording ends."""
        if self.bag is None:
            return False
        try:
            act(self.bag)
        except BagError as error:
            text = f"the recording ends after {self.counters['messages']} messages: {error}"
            self.report.fault = text
            self.get_logger().error(text)
            self.stop(text, exit_code=1)
            self.bag = None
            return False
        return True


class _Taker:
    """A callback that gets each message with its MessageInfo.

    rclpy's events executor hands both over as one tuple, other executors as two arguments.
    """

    __signature__ = inspect.signature(lambda message, info: None)

    def __init__(self, take: Callable[[Any, Any], None]) -> None:
        self._take = take

    def __call__(self, *arguments: Any) -> None:
        self._take(*(arguments if len(arguments) == 2 else arguments[0]))


def _topic(text: str) -> Topic:
    parts = text.split()
    if len(parts) != 3 or parts[2] not in QOS_KINDS:
        kinds = ", ".join(QOS_KINDS)
        raise ConfigurationError(f"topics: '{text}': must be 'NAME TYPE QOS' with a QOS of {kinds}")
    return Topic(*parts)


def main() -> int:
    """Run the node until a signal; returns the exit code."""
    return run(RecorderNode)


if __name__ == "__main__":
    sys.exit(main())
