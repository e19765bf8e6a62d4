"""How a node takes the images of a tactile sensor: as they are, or compressed by image_transport's names."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from sensor_msgs.msg import CompressedImage, Image

from tactile_base import topics
from tactile_drivers.camera import COMPRESSED
from tactile_ros.cdr import ReceivedCompressed, ReceivedImage, compressed_from_bytes, image_from_bytes
from tactile_ros.conversions import MessageError
from tactile_ros.qos import IMAGE

if TYPE_CHECKING:
    from tactile_ros.managed_node import ManagedNode

Received = ReceivedImage | ReceivedCompressed


def subscribe_images(
    node: ManagedNode,
    transport: str,
    callback: Callable[[Received], None],
    age_limit: float,
    stamped: bool = True,
) -> None:
    """Call `callback` with each image, see `ManagedNode.subscribe`; one without a stamp is refused."""
    packed = transport == COMPRESSED
    topic = topics.compressed(topics.IMAGE) if packed else topics.IMAGE
    read: Callable[[bytes], Received] = compressed_from_bytes if packed else image_from_bytes

    def take(data: bytes) -> None:
        received = read(data)
        if received.stamp_ns <= 0:
            raise MessageError("has no stamp, must have the time of its exposure, on the clock of /tf")
        callback(received)

    kind = CompressedImage if packed else Image
    node.subscribe(kind, topic.name, take, IMAGE, age_limit, raw=True, stamped=stamped)
