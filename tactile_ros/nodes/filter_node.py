"""Filter node: estimates + the arm's motion from TF -> belief over the surface contact pose.

Estimates, and contact presences without contact, are taken in the order of stamps; a presence in contact
announces its estimate. Each waits for the sensor's pose at its stamp up to `tf_timeout`; then it is dropped
and counted. One that comes after a later one has been taken is put in its place, if the setting `history`
allows. A backward jump of the clock, the loss of contact and `~/reset` (tactile_msgs/ResetFilter) clear the
belief. Without contact `contact/state` says so and holds no belief.
Forces are filtered apart (`tactile_filter.force`): `contact/wrench_estimate` -> `contact/wrench_belief`.
/diagnostics reports whether the filter's innovations are what its covariances claim.
"""

from __future__ import annotations

import math
import sys
import time
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray

from tactile_base import topics
from tactile_filter.bayes_filter import Belief, ContactFilter, FilterSettings
from tactile_filter.consistency import ConsistencyMonitor, ConsistencySettings
from tactile_filter.contact_bounds import ContactBounds
from tactile_filter.events import Event, measurement_join, says_no_contact
from tactile_filter.force import ForceFilter, ForceGaussian, ForceSettings
from tactile_geometry.gaussian import UNUSABLE, PoseGaussian
from tactile_geometry.transform_buffer import MotionLimits, TransformUnavailable
from tactile_msgs.msg import ContactForce, ContactPresence, ContactState
from tactile_records.messages import force_bytes, state_bytes
from tactile_ros.latency import LatencyPublisher
from tactile_ros.managed_node import ManagedNode, lost_counter
from tactile_ros.message_bytes import HeadedReader, read_force, read_gaussian
from tactile_ros.parameters import SettingsParameters, fixed_settings
from tactile_ros.qos import STATE
from tactile_ros.run_nodes import run
from tactile_ros.transforms import (
    BeliefInputSettings,
    FramePublisher,
    TransformGate,
    TransformListener,
    serve_reset,
)
from tactile_wire.errors import MessageError
from tactile_wire.packing import gaussian_bytes
from tactile_wire.pose_numbers import gaussian_from_numbers

PRESENCE, ESTIMATE = topics.PRESENCE.name, topics.ESTIMATE.name
read_presence = HeadedReader(ContactPresence)


class FilterNode(ManagedNode):
    """See the module's text; the arithmetic is `ContactFilter`."""

    def __init__(self) -> None:
        super().__init__("filter")
        self.settings = SettingsParameters(
            self, FilterSettings(), on_change=lambda settings: self.filter.configure(settings)
        )
        self.inputs = SettingsParameters(
            self, BeliefInputSettings(), prefix="inputs", read_only=("age_limit",)
        )
        self.bounds = fixed_settings(self, ContactBounds(), "bounds")
        self.filter = ContactFilter(self.settings.value, self.bounds)
        self.monitor = ConsistencyMonitor()
        consistency = SettingsParameters(
            self, ConsistencySettings(), prefix="consistency", on_change=self.monitor.configure
        )
        self.monitor.configure(consistency.value)
        self.force = ForceFilter()
        force = SettingsParameters(
            self, ForceSettings(), prefix="force", on_change=lambda settings: self.force.configure(settings)
        )
        self.force.configure(force.value)
        self.limits = fixed_settings(self, MotionLimits(), "transforms")
        self.no_contact_ns = -1
        self.join = measurement_join()

    def configure(self) -> None:
        """Create publishers and subscriptions."""
        self.belief_out = self.publisher(PoseWithCovarianceStamped, topics.BELIEF.name, STATE)
        self.state_out = self.publisher(ContactState, topics.STATE.name, STATE)
        self.latency = LatencyPublisher(self, "filter", self.sensor_frame)
        self.frame_out = FramePublisher(
            self, self.sensor_frame, self.contact_frame, rate=lambda: self.inputs.value.tf_rate
        )
        lookup = self.base_frame, self.sensor_frame
        self.transforms = TransformListener(
            self,
            on_update=self._pump,
            on_jump=lambda reason: self._restart("/tf started anew"),
            ignore=(self.contact_frame,),
            frames=[lookup],
            limits=self.limits,
        )
        self.gate = TransformGate(
            self,
            self.join,
            self.transforms,
            lookup,
            timeout=lambda: self.inputs.value.tf_timeout,
            deliver=self._process,
            drop=self._drop,
        )
        limit = self.inputs.value.age_limit
        frame = self.sensor_frame
        self.subscribe(ContactPresence, PRESENCE, self._take_presence, STATE, limit, raw=True, frame=frame)
        self.estimates = self.subscribe(
            PoseWithCovarianceStamped, ESTIMATE, self._take_estimate, STATE, limit, raw=True, frame=frame
        )
        self.force_out = self.publisher(ContactForce, topics.FORCE_BELIEF.name, STATE)
        self.subscribe(
            ContactForce, topics.FORCE_ESTIMATE.name, self._take_force, STATE, raw=True, frame=frame
        )
        serve_reset(self, lambda: self._restart("service"), "the next measurement starts a new belief")

    def activate(self) -> None:
        """Start with a new filter and without pending inputs."""
        self.filter = ContactFilter(self.settings.value, self.bounds)
        self.report.values.clear()
        self._clear_inputs()

    # ---- inputs ----

    def _take_presence(self, data: bytes) -> None:
        stamp_ns, _, (_, _, in_contact, self.still, self.novelty) = read_presence(data)
        if not in_contact:
            self.force.reset()
            if self.estimates is not None:
                self.estimates.excuse()  # there are none without contact
        if not in_contact or stamp_ns > self.join.done_ns:  # else its estimate came first, as it should
            self._take("presence", stamp_ns, in_contact)

    def _take_estimate(self, data: bytes) -> None:
        stamp_ns, _, numbers = read_gaussian(data)
        try:
            estimate = gaussian_from_numbers(numbers)
        except MessageError as error:
            self._refuse(str(error))
            estimate = UNUSABLE  # the filter predicts in its place
        self._take("estimate", stamp_ns, estimate)

    def _take_force(self, data: bytes) -> None:
        stamp_ns, _, numbers = read_force(data)
        estimate = ForceGaussian(np.array(numbers[:3]), np.reshape(numbers[3:12], (3, 3)))
        if reason := self.force.step(stamp_ns, estimate):
            self.count("forces refused")
            self.warn("force", f"{topics.FORCE_ESTIMATE.name} refused: {reason}")
        elif self.force.belief is not None:
            belief = force_bytes(stamp_ns, self.sensor_frame, self.force.belief, self.force.nis)
            self.force_out.publish(belief)

    def _take(self, source: str, stamp_ns: int, content: Any) -> None:
        """Keep one part of an event and process what has become complete."""
        received_ns = self.now_ns()
        useless = source == "estimate" and stamp_ns <= self.no_contact_ns
        if not useless and not self.join.add(source, stamp_ns, (content, received_ns), time.monotonic_ns()):
            if source == "estimate" and self.settings.value.history > 0.0 and self.filter.has_belief:
                self._take_late(stamp_ns, content)
            else:
                self.warn("late", f"contact/{source} refused: its stamp is not later than the last one's")
        self._pump()

    def _take_late(self, stamp_ns: int, estimate: PoseGaussian) -> None:
        """Put an estimate in its place; what it changes is published with the next belief."""
        try:
            T_base_sensor = self.transforms.lookup(self.base_frame, self.sensor_frame, stamp_ns)
        except TransformUnavailable as error:
            self._refuse(f"it is late, and there is no sensor pose for it: {error}")
            return
        belief = self.filter.step(stamp_ns, estimate, T_base_sensor)
        if "too late" in belief.reason:
            self._refuse(belief.reason)

    def _refuse(self, reason: str) -> None:
        self.count("estimates refused")
        self.warn("estimate", f"contact/estimate refused: {reason}")

    def _pump(self) -> None:
        if self.active:
            self.gate.pump()

    def _drop(self, event: Event, reason: str) -> None:
        self.count("estimates dropped")
        self.warn("drop", f"estimate dropped ({self.counters['estimates dropped']} so far): {reason}")

    def _restart(self, reason: str) -> None:
        self.filter.reset(reason)
        self._clear_inputs()

    # ---- steps ----

    def _process(self, event: Event, T_base_sensor: NDArray[np.float64]) -> None:
        estimate = None
        if says_no_contact(event.parts):
            _, received_ns = event.parts["presence"]
            self.no_contact_ns = event.stamp_ns
        else:
            estimate, received_ns = event.parts["estimate"]
        belief = self.filter.observe(event.stamp_ns, estimate, T_base_sensor)
        emitted_ns = self._publish(belief)
        self.latency.note(event.stamp_ns, received_ns, emitted_ns, self._dropped())

    def _dropped(self) -> int:
        """Frames lost; each has a presence, so the middleware's losses of estimates are among those of it."""
        return self.join.dropped + self.join.late + self.counters[lost_counter(PRESENCE)]

    def _publish(self, belief: Belief) -> int:
        """Publish the belief and return when; the state first, since the controller waits for it."""
        emitted_ns = self.now_ns()
        self.state_out.publish(state_bytes(belief, self.sensor_frame, emitted_ns, self.still, self.novelty))
        if belief.valid:
            self._publish_for_others(belief)
        if belief.reason:
            self.warn("belief", f"belief at {belief.stamp_ns} ns: {belief.reason}")
        self.monitor.add(belief)
        return emitted_ns

    def _publish_for_others(self, belief: Belief) -> None:
        """What people and their tools look at; the controller does not wait for it."""
        stamp_ns, mean = belief.stamp_ns, belief.mean
        self.belief_out.publish(gaussian_bytes(stamp_ns, self.sensor_frame, mean, belief.cov))
        self.frame_out.publish(stamp_ns, mean)

    def publish_diagnostics(self) -> None:
        """Add what the filter refused and how consistent it is."""
        if self.active:
            self._report_counts()
            self._report_consistency()
        super().publish_diagnostics()

    def _report_counts(self) -> None:
        values = self.report.values
        for reason, number in self.filter.resets.items():
            values[f"resets: {reason}"] = str(number)
        values["refused since the last reset"] = str(self.filter.rejected)
        for reason, number in self.filter.rejections.items():
            values[f"refused: {reason}"] = str(number)
        for what, number in self.filter.late.items():
            values[f"late: {what}"] = str(number)

    def _report_consistency(self) -> None:
        report = self.monitor.report()
        low, high = report.nis_bounds
        values = self.report.values
        values["mean NIS / 6"] = f"{report.nis:.3f} (consistent: {low:.2f} to {high:.2f})"
        values["correlation of innovations"] = f"{report.whiteness:.2f} (below {report.whiteness_bound:.2f})"
        values["outliers"] = f"{report.rejected:.1%}"
        values["consistency"] = "; ".join(report.problems) or "no complaint"
        for number, text in enumerate(report.warnings):
            self.report.complain(f"consistency {number}", f"filter {text}")

    def _clear_inputs(self) -> None:
        """Forget what waits, and what the diagnostics rest on."""
        self.join.clear()
        self.monitor.reset()
        self.force.reset()
        self.no_contact_ns = -1
        self.still, self.novelty = False, math.nan  # of the last presence
        self.frame_out.clear()


def main() -> int:
    """Run the node until a signal; returns the exit code."""
    return run(FilterNode)


if __name__ == "__main__":
    sys.exit(main())
