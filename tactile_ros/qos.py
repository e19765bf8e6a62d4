"""Quality of service by kind of topic, so that both ends of a topic always agree.

A depth bounds what a reader keeps in messages, not in bytes: the middleware takes messages of any size where
a type has strings or sequences, as all of ours have by their header. While a node keeps up, few are waiting,
and it drops what is larger than `managed_node.LARGEST` (256 KiB; images 64 MiB, a recorder 4 MiB) unread.
While it is held up, depth times size may wait of what a stranger has sent: for `STATE` and `TF` 100 messages
(26 MB at 256 KiB each, 1 GB at 10 MB), for a recorder up to 20 000 of a topic. docs/safety.md says so, too.
"""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from tactile_base.topics import DIAGNOSTICS as DIAGNOSTICS_TOPIC
from tactile_base.topics import ESTOP, PARAMETER_EVENTS, ROSOUT, SENSOR, Topic
from tactile_base.topics import IMAGE as IMAGE_TOPIC
from tactile_base.topics import LATCHED as LATCHED_KIND

RECORDED = 20_000  # messages of 30 s at 600 Hz, which is more than any of our topics has
RECORDED_SLOW = 2000  # the same of what nodes say now and then: ten of them, five times a second


def _profile(depth: int, reliable: bool = True, latched: bool = False) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


IMAGE = _profile(1, reliable=False)
"""Camera images: SensorData with a depth of one; the newest wins."""

FORCE = _profile(100, reliable=False)
"""What a force sensor says; one that is missing is like the next."""

STATE = _profile(100)
"""Estimates, beliefs, presence, status: small, and each one counts. A node that was held up for fewer than so
many catches up; beyond, the oldest are lost."""

COMMAND = _profile(1)
"""Twists: only the newest matters, and it has to arrive."""

LATENCY = _profile(50)
"""Measurements about the graph itself; a writer that keeps the last 50 never waits for its readers."""

TF = _profile(100)
TF_STATIC = _profile(100, latched=True)
LATCHED = _profile(1, latched=True)
NOTES = _profile(10, latched=True)
"""What a launch has to say at its end, one after the other, to a recorder that may be held up."""

DIAGNOSTICS = _profile(10)

LOOKING = _profile(50, reliable=False)
"""How somebody looks on: he gets the newest, and no publisher keeps for him what he has missed. For a slow
reader that was reliable, nodes on a busy machine kept five minutes of messages: hundreds of MB."""


def writer_profile(profile: QoSProfile) -> QoSProfile:
    """What a publisher keeps of a topic whose readers use this profile.

    A reader takes what it has missed from its writer. What matters to nodes is the newest; a recorder that
    was held up for 30 s wants all of it.
    """
    reliable = profile.reliability == ReliabilityPolicy.RELIABLE
    volatile = profile.durability == DurabilityPolicy.VOLATILE
    return _profile(RECORDED) if reliable and volatile else profile


def viewer_profile(publishers: Sequence[TopicEndpointInfo]) -> QoSProfile:
    """How somebody looks at a topic that may be anybody's: what is said once is there for him, too."""
    offered = [info.qos_profile.durability for info in publishers]
    kept = bool(offered) and all(durability == DurabilityPolicy.TRANSIENT_LOCAL for durability in offered)
    return TF_STATIC if kept else LOOKING


def recorder_profile(topic: Topic) -> QoSProfile:
    """How a recorder reads a topic. Images are too large to wait."""
    slow = topic.name in (DIAGNOSTICS_TOPIC.name, ESTOP.name, PARAMETER_EVENTS.name, ROSOUT.name)
    depth = IMAGE.depth if topic.type == IMAGE_TOPIC.type else RECORDED_SLOW if slow else RECORDED
    return _profile(depth, reliable=topic.qos != SENSOR, latched=topic.qos == LATCHED_KIND)
