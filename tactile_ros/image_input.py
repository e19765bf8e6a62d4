"""How a node takes the images of a tactile sensor: as they are, or compressed by image_transport's names."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage, Image

from tactile_base import topics
from tactile_base.settings import setting
from tactile_base.stamps import SECOND_NS
from tactile_control.phases import StampedImage
from tactile_geometry.transform_buffer import TransformInFuture, TransformUnavailable
from tactile_ros.discovery import PROFILE_VARIABLES
from tactile_ros.managed_node import TOO_FAST, ManagedNode, lost_counter
from tactile_ros.message_bytes import (
    ReceivedCompressed,
    ReceivedImage,
    compressed_from_bytes,
    image_from_bytes,
)
from tactile_ros.qos import IMAGE
from tactile_ros.transforms import TransformListener
from tactile_scene.camera import COMPRESSED, ExternalCameraSettings
from tactile_wire.errors import MessageError

Received = ReceivedImage | ReceivedCompressed
LARGEST_IMAGE = 1 << 26  # bytes: 4096x4096 in colour, and some more
SEGMENT = 512 * 1024  # bytes of shared memory that a process has to publish in, without a profile of Fast DDS


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
    size = 0

    def why_lost() -> str:
        arrived = watch.count if watch is not None else 0
        large = size == 0 or size > SEGMENT
        return too_large(size) if large and node.counters[lost_counter(topic.name)] > arrived else TOO_FAST

    def take(data: bytes) -> None:
        nonlocal size
        size = len(data)
        received = read(data)
        if received.stamp_ns <= 0:
            raise MessageError("has no stamp, must have the time of its exposure, on the clock of /tf")
        callback(replace(received, stamp_ns=received.stamp_ns + shift_ns) if shift_ns else received)

    kind = CompressedImage if packed else Image
    watch = node.subscribe(
        kind, topic.name, take, IMAGE, age_limit, raw=True, stamped=stamped, why_lost=why_lost,
        largest=LARGEST_IMAGE,
    )  # fmt: skip


class PosedImages:
    """The newest image, as soon as the pose of its sensor at the exposure is known, which may come later.

    `take` is the callback for images, `match` is called when poses have come; `act` is called when `newest`,
    the latest image with its pose, has changed. `color`: images that have colors keep them.
    """

    def __init__(self, node: ManagedNode, act: Callable[[], None]) -> None:
        self._node, self._act = node, act
        self.color = False
        self.transforms: TransformListener | None = None
        self.forget()

    def forget(self) -> None:
        """Forget what has been received."""
        self._pending: tuple[int, NDArray[np.uint8]] | None = None
        self.newest: StampedImage | None = None

    def take(self, received: Received) -> None:
        """Keep an image until its pose is known; raises `MessageError` where it cannot be read."""
        image = received.array(self.color).copy()
        if self._pending is not None:
            self._node.count("images without a pose in time")
        self._pending = received.stamp_ns, image
        self.match()

    def match(self) -> None:
        """Put image and pose together, if both are there."""
        if self._pending is None or self.transforms is None:
            return
        node, (stamp_ns, image) = self._node, self._pending
        try:
            T = self.transforms.lookup(node.base_frame, node.sensor_frame, stamp_ns)
        except TransformInFuture:
            return
        except TransformUnavailable as error:
            self._pending = None
            node.count("images without a pose")
            node.warn("pose", f"image left out: {error}")
            return
        self._pending, self.newest = None, StampedImage(stamp_ns, T, image)
        self._act()


def too_large(size: int) -> str:
    """What to do about images of which all but a few are lost, as those are that do not fit into a segment.

    `size` in bytes; 0: none has arrived.
    """
    which = f"images of {size / 1e6:.2f} MB do" if size else "and none has arrived whole: large ones do"
    profile = os.environ.get(PROFILE_VARIABLES[0], "config/dds/this_host.xml")
    return (
        f"messages lost, {which} not fit the {SEGMENT / 1e6:.2f} MB of shared memory of a node without a "
        f"profile; start the camera's node with {PROFILE_VARIABLES[0]}={profile}, or have it publish mono8"
    )
