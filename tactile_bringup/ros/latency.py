"""StageLatency: when a stage of image -> estimate -> belief -> command got its input and gave its output."""

from __future__ import annotations

from tactile_bringup.ros.conversions import header
from tactile_bringup.ros.managed_node import ManagedNode
from tactile_bringup.ros.qos import LATENCY
from tactile_bringup.ros.stamps import time_from_ns
from tactile_msgs.msg import StageLatency


class LatencyPublisher:
    """Publishes the latency of one stage on `latency`; call it after the stage's own output is on its way."""

    def __init__(self, node: ManagedNode, stage: str, frame_id: str) -> None:
        self._publisher = node.publisher(StageLatency, "latency", LATENCY)
        self._stage = stage
        self._frame_id = frame_id

    def publish(self, exposure_ns: int, received_ns: int, emitted_ns: int, dropped: int) -> None:
        """`dropped` is the number of inputs that this stage has dropped since it started."""
        self._publisher.publish(
            StageLatency(
                header=header(exposure_ns, self._frame_id),
                stage=self._stage,
                received=time_from_ns(received_ns),
                emitted=time_from_ns(emitted_ns),
                dropped=dropped,
            )
        )
