"""Object node: the contacts of several arms on one object -> one belief over the object's pose.

Not part of the loop: it is started only where somebody wants it. From each arm of the parameter `arms` it
takes `contact/belief` and, to know at once when a contact ends, `contact/state`. Each belief waits for its
sensor's pose in the world, at the belief's stamp, up to `inputs.tf_timeout`; each stamp waits for the other
arms up to `inputs.wait`. What then is known of the object goes out as `object/belief` in the world's frame
with the stamp of the newest belief in it, and as a frame on /tf; /diagnostics names the contacts that were
used, refused, too old, sliding or without a place. A backward jump of the clock and `~/reset`
(tactile_msgs/ResetFilter) forget all contacts and the places that were found for them.
"""

from __future__ import annotations

import functools
import math
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray

from tactile_base import topics
from tactile_base.settings import SettingError, setting
from tactile_base.stamps import SECOND_NS
from tactile_filter.contact_bounds import ContactBounds
from tactile_filter.events import JUMP_NS, Event, measurement_join, says_no_contact
from tactile_filter.object.merge import EventGroup, EventMerge
from tactile_filter.object.settings import PlaceSettings, TrackerSettings
from tactile_filter.object.tracker import ContactUpdate, ObjectTracker, TrackedObject
from tactile_geometry.gaussian import PoseGaussian, ros_from_left
from tactile_geometry.transform_buffer import MotionLimits
from tactile_msgs.msg import ContactState
from tactile_ros.latency import LatencyPublisher
from tactile_ros.managed_node import ManagedNode, lost_counter
from tactile_ros.message_bytes import STATE_FLAGS, read_gaussian, read_state
from tactile_ros.parameters import SettingsParameters, declare_read_only, fixed_settings
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

MERGE_PERIOD = 0.005  # s; how late a deadline may be kept


@dataclass(frozen=True)
class ObjectInputSettings(BeliefInputSettings):
    """How long the node waits for what it needs, other arms included."""

    wait: float = setting(
        0.02, lower=0.0, upper=1.0, unit="s",
        doc="the belief of one arm waits this long for those of the others up to its stamp, unless they have "
        "been silent for longer than forget_after",
    )  # fmt: skip


class ArmInput:
    """What one arm's filter says, in order and each with the sensor's pose in the world."""

    def __init__(self, node: ObjectNode, arm: str) -> None:
        self.arm = arm
        self.frame = topics.sensor_frame(arm)
        self.join = measurement_join()
        self.topics = topics.BELIEF.of(arm).name, topics.STATE.of(arm).name
        self._node = node
        self._newest_ns = -1
        self.gate = TransformGate(
            node,
            self.join,
            node.transforms,
            (node.world_frame, self.frame),
            timeout=lambda: node.inputs.value.tf_timeout,
            deliver=self._deliver,
            drop=self._drop,
        )
        belief, state = self.topics
        limit = node.inputs.value.age_limit
        node.subscribe(
            PoseWithCovarianceStamped, belief, self._take_belief, STATE, raw=True, frame=self.frame
        )
        node.subscribe(ContactState, state, self._take_state, STATE, limit, raw=True, frame=self.frame)

    def clear(self) -> None:
        """Forget what waits, and all stamps."""
        self.join.clear()
        self._newest_ns = -1

    def dropped(self) -> int:
        """Beliefs lost so far."""
        return self.join.dropped + self.join.late + self._node.counters[lost_counter(self.topics[0])]

    def _take_belief(self, data: bytes) -> None:
        stamp_ns, _, numbers = read_gaussian(data)
        belief = gaussian_from_numbers(numbers)
        objection = self._node.bounds.objection(belief.mean)
        if objection:
            raise MessageError(objection)
        self._take("estimate", stamp_ns, belief)

    def _take_state(self, data: bytes) -> None:
        stamp_ns, _, numbers = read_state(data)
        if int(numbers[STATE_FLAGS]) & ContactState.NO_CONTACT:
            self._take("presence", stamp_ns, False)

    def _take(self, source: str, stamp_ns: int, content: Any) -> None:
        received_ns = self._node.now_ns()
        if self._newest_ns - stamp_ns > JUMP_NS:
            self._node.jumped((self._newest_ns - stamp_ns) / SECOND_NS, f"in the beliefs of {self.arm}")
        self._newest_ns = max(self._newest_ns, stamp_ns)
        if not self.join.add(source, stamp_ns, (content, received_ns), time.monotonic_ns()):
            self._refuse("its stamp is not later than the last one's")
        self.gate.pump()

    def _deliver(self, event: Event, T_world_sensor: NDArray[np.float64]) -> None:
        contact = not says_no_contact(event.parts)
        belief, received_ns = event.parts["estimate" if contact else "presence"]
        update = ContactUpdate(belief, T_world_sensor) if contact else None
        self._node.take(self.arm, event.stamp_ns, update, received_ns)

    def _drop(self, event: Event, reason: str) -> None:
        self._node.count(f"{self.arm}: beliefs dropped")
        self._node.warn(f"{self.arm} drop", f"belief of {self.arm} dropped: {reason}")

    def _refuse(self, reason: str) -> None:
        self._node.count(f"{self.arm}: beliefs refused")
        self._node.warn(f"{self.arm} belief", f"belief of {self.arm} refused: {reason}")


class ObjectNode(ManagedNode):
    """See the module's text; the arithmetic is `ObjectTracker`."""

    def __init__(self) -> None:
        super().__init__("object")
        self.arms = _checked_arms(
            declare_read_only(self, "arms", [""], "names of the arms whose contacts are on the object")
        )
        self.world_frame = declare_read_only(
            self, "world_frame", topics.WORLD, "frame that all arms have in common"
        )
        self.object_frame = declare_read_only(
            self, "object_frame", topics.OBJECT, "name of the object's frame on /tf"
        )
        self.settings = SettingsParameters(
            self, TrackerSettings(), on_change=lambda settings: self.tracker.configure(settings)
        )
        self.inputs = SettingsParameters(
            self, ObjectInputSettings(), prefix="inputs", read_only=("age_limit",)
        )
        self.limits = fixed_settings(self, MotionLimits(), "transforms")
        self.bounds = fixed_settings(self, ContactBounds(), "bounds")
        known: dict[str, PoseGaussian] = {}
        for arm in self.arms:
            change = functools.partial(self._change_place, arm)
            given = SettingsParameters(self, PlaceSettings(), prefix=f"place.{arm}", on_change=change)
            known |= {arm: place} if (place := given.value.place()) is not None else {}
        self.tracker = ObjectTracker(self.arms, self.settings.value, known)
        self.merge = EventMerge(self.arms)
        self.last: TrackedObject | None = None

    def command_topics(self) -> list[str]:
        """Of all its arms."""
        return [topics.COMMAND.of(arm).name for arm in self.arms]

    def configure(self) -> None:
        """Create publishers and subscriptions."""
        self.belief_out = self.publisher(PoseWithCovarianceStamped, topics.OBJECT_BELIEF.name, STATE)
        self.frame_out = FramePublisher(
            self, self.world_frame, self.object_frame, rate=lambda: self.inputs.value.tf_rate
        )
        self.latency = LatencyPublisher(self, "object", self.world_frame, topics.OBJECT_LATENCY.name)
        self.transforms = TransformListener(
            self,
            on_update=self._pump,
            on_jump=lambda reason: self._clear("/tf started anew"),
            ignore=(self.object_frame,),
            frames=[(self.world_frame, topics.sensor_frame(arm)) for arm in self.arms],
            limits=self.limits,
        )
        self.contacts = [ArmInput(self, arm) for arm in self.arms]
        self.timer(MERGE_PERIOD, self._hand_on)
        serve_reset(self, lambda: self._clear("service"), "the next contacts count anew")

    def activate(self) -> None:
        """Start without contacts and without pending inputs."""
        self._clear("activated")

    # ---- inputs ----

    def take(self, arm: str, stamp_ns: int, update: ContactUpdate | None, received_ns: int) -> None:
        """Merge what an arm's filter said with what the others say."""
        self.merge.add(arm, stamp_ns, (update, received_ns), time.monotonic_ns())
        self._hand_on()

    def jumped(self, seconds: float, where: str) -> None:
        """Start anew in the time after a jump."""
        self.count("restarts")
        self.warn("jump", f"time jumped back by {seconds:.3f} s {where}: all contacts are forgotten")
        self._clear("time jumped back")

    def _pump(self) -> None:
        if self.active:
            for contact in self.contacts:
                contact.gate.pump()

    def _hand_on(self) -> None:
        """Take what need not wait any more."""
        wait_ns = round(self.inputs.value.wait * SECOND_NS)
        silence_ns = round(self.settings.value.forget_after * SECOND_NS)
        for group in self.merge.take(time.monotonic_ns(), wait_ns, silence_ns):
            self._process(group)

    # ---- steps ----

    def _process(self, group: EventGroup) -> None:
        updates = {arm: update for arm, (update, _) in group.parts.items()}
        found = self.tracker.step(group.stamp_ns, updates)
        if found is None:
            return
        self.last = found
        for arm, nis in found.belief.refused.items():
            self.count(f"{arm}: contacts refused")
            self.warn(f"{arm} refused", f"contact of {arm} refused: NIS {nis:.4g} against the others")
        if found.belief.pose is None:
            return
        pose = found.belief.pose.gaussian
        emitted_ns = self.now_ns()
        self.belief_out.publish(gaussian_bytes(found.stamp_ns, self.world_frame, pose.mean, pose.cov))
        self.frame_out.publish(found.stamp_ns, pose.mean)
        received_ns = min(received for _, received in group.parts.values())
        dropped = sum(contact.dropped() for contact in self.contacts)
        self.latency.note(found.stamp_ns, received_ns, emitted_ns, dropped)

    def publish_diagnostics(self) -> None:
        """Add which contacts the belief rests on."""
        if self.active:
            self.report.values.update(self._values())
        super().publish_diagnostics()

    def _values(self) -> dict[str, str]:
        """What is known of the object, for people."""
        values = {f"updates refused: {why}": str(n) for why, n in self.tracker.refused.items()}
        found = self.last
        if found is None:
            return values | {"object": "nothing heard yet"}
        stale = [f"{arm} ({age * 1e3:.0f} ms)" for arm, age in found.stale.items()]
        sliding = [f"{arm} (shear {ratio:.2f} of depth)" for arm, ratio in found.sliding.items()]
        refused = [f"{arm} (NIS {nis:.4g})" for arm, nis in found.belief.refused.items()]
        return values | {
            "object": found.reason or _sigma_text(found),
            "contacts used": ", ".join(sorted(found.belief.used)) or "none",
            "contacts refused": ", ".join(refused) or "none",
            "contacts too old": ", ".join(stale) or "none",
            "contacts that may slide": ", ".join(sliding) or "none",
            "contacts without a place": ", ".join(found.unplaced) or "none",
            "stamps overtaken": str(self.merge.overtaken),
        }

    # ---- reset and parameters ----

    def _clear(self, reason: str) -> None:
        """Start anew, inputs included."""
        self.tracker.reset(reason)
        self.last = None
        self.frame_out.clear()
        self.count(f"resets: {reason}")
        self.merge.clear()
        for contact in self.contacts:
            contact.clear()

    def _change_place(self, arm: str, place: PlaceSettings) -> None:
        self.tracker.set_place(arm, place.place())
        self.last = None
        self.count("resets: place changed")


def _checked_arms(names: tuple[str, ...]) -> tuple[str, ...]:
    """The arms' names; raises `SettingError` if there is none, an empty one, or one twice."""
    if not any(names):
        raise SettingError("parameter arms: must name at least one arm, such as ['left', 'right']")
    if "" in names or len(set(names)) < len(names):
        raise SettingError(f"parameter arms = {list(names)}: each must have a name, and be there once")
    return tuple(names)


def _sigma_text(found: TrackedObject) -> str:
    """How well position and rotation are known, in words."""
    assert found.belief.pose is not None
    pose = found.belief.pose.gaussian
    variances = np.diagonal(ros_from_left(pose.cov, pose.mean[:3, 3]))
    position, rotation = (math.sqrt(part.mean()) for part in (variances[:3], variances[3:]))
    return f"known to {position * 1e3:.3f} mm and {math.degrees(rotation):.3f} degrees (1 sigma, an axis)"


def main() -> int:
    """Run the node until a signal; returns the exit code."""
    return run(ObjectNode)


if __name__ == "__main__":
    sys.exit(main())
