"""Quality of service by kind of topic, so that both ends of a topic always agree."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from tactile_base.topics import IMAGE as IMAGE_TOPIC
from tactile_base.topics import LATCHED as LATCHED_KIND
from tactile_base.topics import SENSOR, Topic

RECORDED = 20_000  # messages of 30 s at 600 Hz, which is more than any of our topics has


def _profile(depth: int, reliable: bool = True, latched: bool = False) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


IMAGE = _profile(1, reliable=False)
"""Camera images: SensorData with a depth of one; the newest wins."""

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
DIAGNOSTICS = _profile(10)


def writer_profile(profile: QoSProfile) -> QoSProfile:
    """What a publisher keeps of a topic whose readers use this profile.

    A reader takes what it has missed from its writer. What matters to nodes is the newest; a recorder that
    was held up for 30 s wants all of it.
    """
    reliable = profile.reliability == ReliabilityPolicy.RELIABLE
    volatile = profile.durability == DurabilityPolicy.VOLATILE
    return _profile(RECORDED) if reliable and volatile else profile


def recorder_profile(topic: Topic) -> QoSProfile:
    """How a recorder reads a topic. Images are too large to wait."""
    depth = IMAGE.depth if topic.type == IMAGE_TOPIC.type else RECORDED
    return _profile(depth, reliable=topic.qos != SENSOR, latched=topic.qos == LATCHED_KIND)
