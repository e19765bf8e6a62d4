"""Estimator node: camera images -> Gaussian over the surface contact pose, and contact presence.

For each image it publishes `contact/presence` and, in contact, `contact/estimate` before it: a network always
answers, but without contact there is nothing to estimate. A network that tells the force has it published as
`contact/wrench` (its torque is 0: not told) and, with covariance, `contact/wrench_estimate`. All have the
image's exposure stamp.
The newest image wins: what it replaces is told by the stamps and counted. Images become what the model was
trained on where its file says how (`estimating.encodings`, `Preprocessor`). Images that cannot be
used (another encoding, another size, no picture of the sensor: `estimating.image_check`) and answers of the
network that are not a Gaussian are refused, counted and told in /diagnostics, at once when it begins.

After activation the first images, taken without contact, become the reference of the contact presence; until
then nothing is published. Images in which the network sees a contact, or that differ from the last reference
as contact does, are refused, and the last one stays. `~/capture_reference` (std_srvs/Trigger) takes a new one
that may differ.
"""

from __future__ import annotations

import functools
import math
import sys
from dataclasses import dataclass

from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from numpy.typing import NDArray
from std_srvs.srv import Trigger

from tactile_base import topics
from tactile_base.settings import setting
from tactile_base.stamps import SECOND_NS
from tactile_msgs.msg import ContactForce
from tactile_msgs.msg import ContactPresence as PresenceMessage
from tactile_perception.estimating.estimator import Estimator, EstimatorSettings, ModelError
from tactile_perception.estimating.image import ImageError
from tactile_perception.estimating.image_check import ImageCheck, ImageCheckSettings, ImageRefused
from tactile_perception.estimating.novelty import NoveltyDrift
from tactile_perception.estimating.perceive import Perceiver, Percept
from tactile_perception.estimating.presence import ContactPresence, PresenceSettings
from tactile_records.messages import force_bytes
from tactile_ros.image_input import ImageTopicSettings, Received, subscribe_images
from tactile_ros.latency import LatencyPublisher
from tactile_ros.managed_node import ConfigurationError, ManagedNode
from tactile_ros.message_bytes import headed_bytes
from tactile_ros.parameters import SettingsParameters
from tactile_ros.qos import STATE
from tactile_ros.run_nodes import run
from tactile_wire.errors import MessageError
from tactile_wire.packing import gaussian_bytes

#: Counters of what has been dropped.
LONGEST_GAP = 600 * SECOND_NS  # a longer one between two stamps is another time, not lost images
DROPPED = ("images lost", "images refused", "images out of order", "estimates refused")


@dataclass(frozen=True)
class ImageInputSettings(ImageTopicSettings):
    """How images are expected to arrive."""

    rate: float = setting(
        60.0,
        lower=0.1,
        upper=1000.0,
        unit="Hz",
        doc="rate of the camera; a larger gap between stamps is lost images",
    )
    age_limit: float = setting(
        0.25, lower=0.005, upper=60.0, unit="s", doc="longer silence of the camera is told in /diagnostics"
    )


class EstimatorNode(ManagedNode):
    """See the module's text; the arithmetic is `Perceiver`."""

    def __init__(self) -> None:
        super().__init__("estimator")
        self.model = SettingsParameters(self, EstimatorSettings(), read_only=("model", "threads"))
        self.images = SettingsParameters(
            self,
            ImageInputSettings(),
            prefix="images",
            read_only=("age_limit", "transport", "time_offset"),
        )
        self.presence = ContactPresence()
        presence = SettingsParameters(
            self, PresenceSettings(), prefix="presence", on_change=self.presence.configure
        )
        self.presence.configure(presence.value)
        self.check = ImageCheck()
        checked = SettingsParameters(
            self, ImageCheckSettings(), prefix="check", on_change=self.check.configure
        )
        self.check.configure(checked.value)
        self.last_stamp_ns = 0
        self.refusing = False
        self.novelty = NoveltyDrift()

    def configure(self) -> None:
        """Load the model, run it warm, and create publishers and subscription."""
        settings = self.model.value
        try:
            estimator = Estimator(settings.model, settings.threads)
        except ModelError as error:
            raise ConfigurationError(str(error)) from error
        self.report.values["model"] = str(estimator.path)
        self.perceive = Perceiver(estimator, self.presence, self.check)
        self.presence_out = self.publisher(PresenceMessage, topics.PRESENCE.name, STATE)
        self.estimate_out = self.publisher(PoseWithCovarianceStamped, topics.ESTIMATE.name, STATE)
        told = estimator.metadata.contact_model
        if told.forces:
            self.wrench_out = self.publisher(WrenchStamped, topics.WRENCH.name, STATE)
            self.force_out = self.publisher(ContactForce, topics.FORCE_ESTIMATE.name, STATE)
        self.report.values["contact model"] = told.name
        self.report.values["preprocessing"] = estimator.metadata.preprocessing.steps
        if told.unknown:
            self.report.values["not labelled"] = ", ".join(told.unknown)
            self.get_logger().warning(f"{estimator.path}: {told.says_unknown()}")
        self.latency = LatencyPublisher(self, "estimator", self.sensor_frame)
        success_message = "the next images become the reference"
        capture = functools.partial(self.presence.capture, compare=False)
        self.serve_request(Trigger, "~/capture_reference", lambda request: capture(), success_message)
        images = self.images.value
        subscribe_images(self, images, self._receive, images.age_limit)

    def activate(self) -> None:
        """Take a new reference image; the last one stays if that is none."""
        self.last_stamp_ns = 0
        self.novelty = NoveltyDrift()
        self.presence.capture()

    def _receive(self, image: Received) -> None:
        received_ns = self.now_ns()
        if not self._in_order(image.stamp_ns):
            return
        try:
            color = self.perceive.estimator.metadata.preprocessing.color
            self._process(image.array(color), image.stamp_ns, received_ns)
        except (MessageError, ImageError) as error:
            if isinstance(error, ImageRefused):
                self.count(f"images refused, {error.kind}")
            self._refuse_now("images refused", f"tactile/image refused: {error}")

    def _process(self, image: NDArray, stamp_ns: int, received_ns: int) -> None:
        percept = self.perceive(image, stamp_ns=stamp_ns)
        self.refusing = self.refusing and bool(percept.fault)
        if percept.in_contact is None:
            self._tell_reference(percept.fault)
            return
        self._publish_estimate(percept, stamp_ns)
        emitted_ns = self.now_ns()
        self.novelty.add(percept.novelty)
        flags = percept.in_contact, percept.still
        numbers = percept.score, self.presence.settings.on, *flags, percept.novelty
        self.presence_out.publish(headed_bytes(PresenceMessage, stamp_ns, self.sensor_frame, *numbers))
        self.latency.note(stamp_ns, received_ns, emitted_ns, self._dropped())
        self.perceive.catch_up()

    def _publish_estimate(self, percept: Percept, stamp_ns: int) -> None:
        if percept.fault:
            self._refuse_now("estimates refused", f"estimate refused: {percept.fault}")
        if percept.estimate is not None:
            mean, cov = percept.estimate.mean, percept.estimate.cov
            self.estimate_out.publish(gaussian_bytes(stamp_ns, self.sensor_frame, mean, cov))
        if percept.force is not None:
            force = percept.force.mean.tolist()
            wrench = headed_bytes(WrenchStamped, stamp_ns, self.sensor_frame, *force, 0.0, 0.0, 0.0)
            self.wrench_out.publish(wrench)
            self.force_out.publish(force_bytes(stamp_ns, self.sensor_frame, percept.force))

    def _in_order(self, stamp_ns: int) -> bool:
        """Count what is missing since the last image; False for an image that is not later than it."""
        last_ns, self.last_stamp_ns = self.last_stamp_ns, stamp_ns
        gap = stamp_ns - last_ns
        if last_ns == 0 or not -SECOND_NS <= gap < LONGEST_GAP:  # the first image, or the clock was set
            return True
        if gap <= 0:
            self.last_stamp_ns = last_ns
            late = f"tactile/image refused: stamp is {-gap / 1e6:.3f} ms before the last"
            self._refuse("images out of order", late)
            return False
        missing = round(gap * 1e-9 * self.images.value.rate) - 1
        if missing > 0:
            self.count("images lost", missing)
            lost = self.counters["images lost"]
            self.warn("lost", f"tactile/image: {lost} lost so far, {missing} just now")
        return True

    def _refuse(self, counter: str, text: str) -> None:
        self.count(counter)
        self.warn(counter, text)

    def _refuse_now(self, counter: str, text: str) -> None:
        """Refuse, and say so at once where it begins: a task is to know why before it fails for it."""
        self._refuse(counter, text)
        if not self.refusing:
            self.refusing = True
            self.publish_diagnostics()

    def publish_diagnostics(self) -> None:
        """Add how unlike the training images the latest ones are."""
        measure = self.perceive.estimator.metadata.novelty if self.active else None
        if measure is not None and not math.isnan(self.novelty.mean):
            mean = f"{self.novelty.mean:.2f}, usual is up to {measure.usual:.2f}, foreign above 1"
            self.report.values["mean novelty of images"] = mean
            if complaint := self.novelty.complaint(measure.usual):
                self.report.complain("novelty", complaint)
        super().publish_diagnostics()

    def _dropped(self) -> int:
        return sum(self.counters[name] for name in DROPPED)

    def _tell_reference(self, refused: str) -> None:
        if refused:
            consequence = "the last one stays" if self.presence.ready else "nothing is published without one"
            remedy = f"Lift the sensor off and type: tactile reference {self.get_namespace().strip('/')}"
            text = f"reference of the contact presence refused: {refused}; {consequence}. {remedy}"
            self._refuse("references refused", text)
        elif self.presence.ready:
            self.get_logger().info(
                "reference of the contact presence taken: nothing may have touched the sensor"
            )
        else:
            self.report.complain("reference", "waiting for images without contact, for the reference")


def main() -> int:
    """Run the node until a signal; returns the exit code."""
    return run(EstimatorNode)


if __name__ == "__main__":
    sys.exit(main())
