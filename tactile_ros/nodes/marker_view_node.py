"""Marker view node: a picture of the markers and of the change of their density, for people.

Not part of the loop: it is started only where somebody wants to look. It subscribes to `tactile/image` and
publishes `tactile/marker_view` (sensor_msgs/Image, bgr8) with the image's stamp, at most `rate` a second.
The first image after activation, taken without contact, is the reference; `~/capture_reference`
(std_srvs/Trigger) takes the next one.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from tactile_base import topics
from tactile_base.settings import setting
from tactile_base.stamps import SECOND_NS
from tactile_perception.estimating.image import ImageError
from tactile_perception.markers.detection import DetectedMarkers, DetectionSettings, density_change, detect
from tactile_perception.markers.view import side_by_side
from tactile_ros.conversions import header
from tactile_ros.image_input import ImageTopicSettings, Received, subscribe_images
from tactile_ros.managed_node import ManagedNode
from tactile_ros.parameters import SettingsParameters
from tactile_ros.qos import IMAGE
from tactile_ros.run_nodes import run
from tactile_wire.errors import MessageError


@dataclass(frozen=True)
class MarkerViewSettings(ImageTopicSettings):
    """How often a picture is made."""

    rate: float = setting(
        10.0, lower=0.1, upper=240.0, unit="Hz", doc="pictures a second at most; other images are passed over"
    )
    age_limit: float = setting(
        2.0, lower=0.005, upper=60.0, unit="s", doc="longer silence of the camera is told in /diagnostics"
    )


class MarkerViewNode(ManagedNode):
    """See the module's text; the arithmetic is `tactile_perception.markers.detection`."""

    def __init__(self) -> None:
        super().__init__("marker_view")
        fixed = ("age_limit", "transport", "time_offset")
        self.view = SettingsParameters(self, MarkerViewSettings(), read_only=fixed)
        self.detection = SettingsParameters(self, DetectionSettings(), prefix="detection")
        self.reference: DetectedMarkers | None = None
        self.last_stamp_ns = 0

    def configure(self) -> None:
        """Create publisher, service and subscription."""
        self.pictures = self.publisher(Image, topics.MARKER_VIEW.name, IMAGE)
        success_message = "the next image becomes the reference"
        self.serve_request(Trigger, "~/capture_reference", self._capture_reference, success_message)
        view = self.view.value
        subscribe_images(self, view, self._receive, view.age_limit, stamped=False)

    def activate(self) -> None:
        """Start with a new reference."""
        self.reference, self.last_stamp_ns = None, 0

    def _receive(self, received: Received) -> None:
        gap_ns = received.stamp_ns - self.last_stamp_ns
        # a little early is in time: the camera's stamps are not whole parts of the period
        if 0 <= gap_ns < 0.95 * SECOND_NS / self.view.value.rate:
            return
        self.last_stamp_ns = received.stamp_ns
        try:
            image = received.array()
            markers = detect(image, self.detection.value)
            if self.reference is None:
                spacing = markers.spacing()  # which raises where there are too few
                self.reference, what = markers, f"{len(markers)} markers, {spacing:.1f} px apart"
                self.get_logger().info(f"reference: {what}; nothing may have touched the sensor")
            picture = side_by_side(image, markers, density_change(markers, self.reference, image.shape))
        except (MessageError, ImageError) as error:
            self.count("images refused")
            self.warn("images refused", f"tactile/image refused: {error}")
            return
        height, width = picture.shape[:2]
        self.pictures.publish(
            Image(
                header=header(received.stamp_ns, self.sensor_frame), height=height, width=width,
                encoding="bgr8", step=3 * width, data=picture.tobytes(),
            )
        )  # fmt: skip

    def _capture_reference(self, request: Trigger.Request) -> None:
        self.reference = None


def main() -> int:
    """Run the node until a signal; returns the exit code."""
    return run(MarkerViewNode)


if __name__ == "__main__":
    sys.exit(main())
