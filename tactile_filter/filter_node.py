"""Filter node: estimates + the arm's motion from TF -> belief over the surface contact pose.

Estimate and contact presence of one exposure are joined by their stamp and taken in the order of stamps. Each waits
for the sensor's pose at its stamp up to `tf_timeout`; then it is dropped and counted. A backward jump of the
clock, the loss of contact and `~/reset` (tactile_msgs/ResetFilter) clear the belief. Without contact
`contact/state` says so and holds no belief.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray

from tactile_bringup.ros.conversions import MessageError, gaussian_from_message, gaussian_message, header
from tactile_bringup.ros.latency import LatencyPublisher
from tactile_bringup.ros.managed_node import ManagedNode, run
from tactile_bringup.ros.parameters import SettingsParameters
from tactile_bringup.ros.qos import STATE
from tactile_bringup.ros.stamps import Event, EventJoin, duration_from_ns, ns_from_time
from tactile_bringup.ros.transforms import TransformGate, TransformListener
from tactile_filter import se3
from tactile_filter.bayes_filter import Belief, ContactFilter, FilterSettings
from tactile_filter.settings import Settings, setting
from tactile_msgs.msg import ContactPresence, ContactState
from tactile_msgs.srv import ResetFilter


@dataclass(frozen=True)
class FilterInputSettings(Settings):
    """How long the filter waits for what it needs."""

    tf_timeout: float = setting(
        0.05, lower=0.0, upper=5.0, unit="s", doc="an estimate waits this long for the sensor's pose at its stamp"
    )
    age_limit: float = setting(
        0.25, lower=0.005, upper=60.0, unit="s", doc="longer silence of the estimator is told in /diagnostics"
    )


class FilterNode(ManagedNode):
    """See the module's text; the arithmetic is `ContactFilter`."""

    def __init__(self) -> None:
        super().__init__("filter")
        self.settings = SettingsParameters(self, FilterSettings(), on_change=self._change_settings)
        self.inputs = SettingsParameters(self, FilterInputSettings(), prefix="inputs", read_only=("age_limit",))
        self.filter: ContactFilter | None = None
        self.join = EventJoin(("presence", "estimate"))
        self.rejected = 0

    def configure(self) -> None:
        """Create the filter, publishers and subscriptions."""
        self.filter = ContactFilter(self.settings.value)
        self.belief_out = self.publisher(PoseWithCovarianceStamped, "contact/belief", STATE)
        self.state_out = self.publisher(ContactState, "contact/state", STATE)
        self.latency = LatencyPublisher(self, "filter", self.sensor_frame)
        self.transforms = TransformListener(self, on_update=self._pump, on_jump=self._jumped)
        self.gate = TransformGate(
            self,
            self.join,
            self.transforms,
            (self.base_frame, self.sensor_frame),
            timeout=lambda: self.inputs.value.tf_timeout,
            deliver=self._process,
            drop=self._drop,
        )
        limit = self.inputs.value.age_limit
        self.subscribe(ContactPresence, "contact/presence", self._take_presence, STATE, limit)
        self.subscribe(PoseWithCovarianceStamped, "contact/estimate", self._take_estimate, STATE, limit)
        self.serve(ResetFilter, "~/reset", self._serve_reset)

    def activate(self) -> None:
        """Start without a belief and without pending inputs."""
        self._reset("activated")
        self.join.clear()

    def cleanup(self) -> None:
        """Forget the filter."""
        self.filter = None

    # ---- inputs ----

    def _take_presence(self, message: ContactPresence) -> None:
        self._take("presence", ns_from_time(message.header.stamp), message.in_contact)

    def _take_estimate(self, message: PoseWithCovarianceStamped) -> None:
        received_ns = self.now_ns()
        try:
            estimate = gaussian_from_message(message.pose)
        except MessageError as error:
            self.count("estimates refused")
            self.warn("estimate", f"contact/estimate refused: {error}")
            return
        self._take("estimate", ns_from_time(message.header.stamp), (estimate, received_ns))

    def _take(self, source: str, stamp_ns: int, content: Any) -> None:
        if not self.join.add(source, stamp_ns, content, time.monotonic_ns()):
            self.warn("late", f"contact/{source} refused: its stamp is not later than the last one's")
        self._pump()

    def _pump(self) -> None:
        if self.active:
            self.gate.pump()

    def _drop(self, event: Event, reason: str) -> None:
        self.warn("drop", f"estimate dropped ({self.join.dropped} so far): {reason}")

    # ---- steps ----

    def _process(self, event: Event, T_base_sensor: NDArray[np.float64]) -> None:
        assert self.filter is not None
        estimate, received_ns = event.parts["estimate"]
        if event.parts["presence"]:
            belief = self.filter.step(event.stamp_ns, estimate, T_base_sensor)
            self._publish_belief(belief)
        else:
            if self.filter.has_belief:
                self._reset("no contact")
            self.state_out.publish(self._state_without_belief(event.stamp_ns))
        self.count("estimates processed")
        dropped = self.join.dropped + self.join.late + self.counters["estimates refused"]
        self.latency.publish(event.stamp_ns, received_ns, self.now_ns(), dropped)

    def _publish_belief(self, belief: Belief) -> None:
        message = self._state(belief)
        self.state_out.publish(message)
        if not message.flags & ContactState.INVALID:
            self.belief_out.publish(
                gaussian_message(belief.stamp_ns, self.sensor_frame, belief.mean, belief.cov)
            )
