"""Quality of service by kind of topic, so that both ends of a topic always agree."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


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
