"""How a node takes the images of a tactile sensor: as they are, or compressed by image_transport's names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from sensor_msgs.msg import CompressedImage, Image

from tactile_base import topics
from tactile_base.settings import setting
from tactile_base.stamps import SECOND_NS
from tactile_drivers.camera import COMPRESSED, ExternalCameraSettings
from tactile_ros.cdr import ReceivedCompressed, ReceivedImage, compressed_from_bytes, image_from_bytes
from tactile_ros.conversions import MessageError
from tactile_ros.qos import IMAGE

if TYPE_CHECKING:
    from tactile_ros.managed_node import ManagedNode

Received = ReceivedImage | ReceivedCompressed


@dataclass(frozen=True)
class ImageTopicSettings(ExternalCameraSettings):
    """How the images of a camera are taken from their topic."""

    time_offset: float = setting(
        0.0, unit="s", lower=-0.5, upper=0.5,
        doc="added to the stamps of somebody else's camera; our camera node has added it already",
    )  # fmt: skip


def subscribe_images(
    node: ManagedNode,
    settings: ImageTopicSettings,
    callback: Callable[[Received], None],
    age_limit: float,
    stamped: bool = True,
) -> None:
    """Call `callback` with each image, see `ManagedNode.subscribe`; one without a stamp is refused."""
    packed = settings.transport == COMPRESSED
    shift_ns = round(settings.time_offset * SECOND_NS)
    topic = topics.compressed(topics.IMAGE) if packed else topics.IMAGE
    read: Callable[[bytes], Received] = compressed_from_bytes if packed else image_from_bytes

    def take(data: bytes) -> None:
        received = read(data)
        if received.stamp_ns <= 0:
            raise MessageError("has no stamp, must have the time of its exposure, on the clock of /tf")
        callback(replace(received, stamp_ns=received.stamp_ns + shift_ns) if shift_ns else received)

    kind = CompressedImage if packed else Image
    node.subscribe(kind, topic.name, take, IMAGE, age_limit, raw=True, stamped=stamped)
