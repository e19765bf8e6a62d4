"""How late the outputs of a stage are: on the topic `latency`, and in /diagnostics."""

from __future__ import annotations

from tactile_base import topics
from tactile_msgs.msg import StageLatency
from tactile_ros.conversions import header, time_from_ns
from tactile_ros.managed_node import ManagedNode
from tactile_ros.qos import LATENCY

LATENCY_PERIOD = 0.25  # s; a message a frame would cost every stage, and listeners, more than some stages do


class LatencyPublisher:
    """Publishes the latency of one stage on `topic`, four times a second, and tells it in /diagnostics.

    `note` what has become of a frame after the stage's own output is on its way.
    """

    def __init__(
        self, node: ManagedNode, stage: str, frame_id: str, topic: str = topics.LATENCY.name
    ) -> None:
        self._publisher = node.publisher(StageLatency, topic, LATENCY)
        self._node, self._stage, self._frame_id = node, stage, frame_id
        self._noted: list[tuple[int, int, int, int]] = []
        node.timer(LATENCY_PERIOD, self._publish)

    def note(self, exposure_ns: int, received_ns: int, emitted_ns: int, dropped: int) -> None:
        """`dropped` is the number of inputs that this stage has dropped since it started."""
        self._noted.append((exposure_ns, received_ns, emitted_ns, dropped))

    def _publish(self) -> None:
        if not self._noted:
            return
        exposed, received, emitted, dropped = zip(*self._noted, strict=True)
        self._noted.clear()
        ages = sorted(out - exposure for exposure, out in zip(exposed, emitted, strict=True))
        self._node.report.values[f"{self._stage}: age of outputs, median and largest (ms)"] = (
            f"{ages[len(ages) // 2] * 1e-6:.1f} {ages[-1] * 1e-6:.1f}"
        )
        times = {"exposed": exposed, "received": received, "emitted": emitted}
        stamped = {name: list(map(time_from_ns, stamps)) for name, stamps in times.items()}
        head = header(self._node.now_ns(), self._frame_id)
        self._publisher.publish(StageLatency(header=head, stage=self._stage, dropped=dropped, **stamped))
