"""What a bag lacks after its recorder was held up: python bench/recorder_stall.py [SECONDS ...]

The recorder is stopped (SIGSTOP) for so long while messages of the size and rate of one arm's go on: state,
belief, estimate, presence and truth at 60 Hz each, /tf at 540 Hz. Then it goes on, and four seconds later it
is asked to end. Printed: messages published, recorded, and lost by the bag's own account.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.serialization import serialize_message

from tactile_base.topics import BELIEF, ESTIMATE, PRESENCE, STATE, TF, TRUTH
from tactile_bringup.launching.environment import ros_environment
from tactile_bringup.launching.processes import ProcessGroup, tail
from tactile_msgs.msg import ContactPresence, ContactState, ContactTruth
from tactile_records.bags.contents import UNKNOWN
from tactile_records.bags.reader import read_bag
from tactile_ros import qos
from tactile_ros.conversions import transform_stamped
from tactile_ros.discovery import use_dds_profile

ARM = "arm"
TICK = 1.0 / 540.0  # s
TICKS_A_FRAME = 9
BEFORE, AFTER = 2.0, 2.0  # s
DISCOVERY = 1.0  # s


@dataclass
class Source:
    """A publisher of one message over and over."""

    topic: str
    publisher: Any
    data: bytes
    count: int = 0

    def publish(self) -> None:
        self.publisher.publish(self.data)
        self.count += 1


def sources(node: Any) -> list[Source]:
    """The publishers of an arm that a replay needs; the first is /tf."""
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from tf2_msgs.msg import TFMessage

    transform = TFMessage(transforms=[transform_stamped(5, "arm/base", "arm/tool", np.eye(4))])
    messages = [(TF, transform, qos.TF)]
    messages += [(topic.of(ARM), PoseWithCovarianceStamped(), qos.STATE) for topic in (BELIEF, ESTIMATE)]
    kinds = ((STATE, ContactState()), (PRESENCE, ContactPresence()), (TRUTH, ContactTruth()))
    messages += [(topic.of(ARM), message, qos.STATE) for topic, message in kinds]
    return [
        Source(
            topic.name,
            node.create_publisher(type(message), topic.name, qos.writer_profile(profile)),
            serialize_message(message),
        )
        for topic, message, profile in messages
    ]


def publish(found: list[Source], seconds: float) -> None:
    """All of them at their rates for so long."""
    start = time.monotonic()
    for tick in range(round(seconds / TICK)):
        time.sleep(max(0.0, start + tick * TICK - time.monotonic()))
        found[0].publish()
        if tick % TICKS_A_FRAME == 0:
            for source in found[1:]:
                source.publish()


def measure(node: Any, group: ProcessGroup, variables: dict[str, str], folder: Path, stall: float) -> str:
    """Hold one recorder up; a row of the table."""
    found = sources(node)
    topics = ", ".join(f"'{source.topic} {_type(source)} reliable'" for source in found)
    arguments = ["--ros-args", "-p", f"bag:={folder / 'bag'}", "-p", f"topics:=[{topics}]"]
    command = [sys.executable, "-m", "tactile_ros.nodes.recorder_node", *arguments]
    recorder = group.start("recorder", command, variables, folder / "recorder.log").process
    while any(source.publisher.get_subscription_count() == 0 for source in found):
        group.check()
        time.sleep(0.05)
    time.sleep(DISCOVERY)
    publish(found, BEFORE)
    os.kill(recorder.pid, signal.SIGSTOP)
    publish(found, stall)
    os.kill(recorder.pid, signal.SIGCONT)
    publish(found, AFTER)
    time.sleep(AFTER)
    group.stop(["recorder"])
    for source in found:
        node.destroy_publisher(source.publisher)
    print(tail(folder / "recorder.log"), file=sys.stderr)
    bag = read_bag(folder / "bag", lambda topic, type_name: False)
    published, recorded = sum(source.count for source in found), sum(bag.counts.values())
    told = str(sum(bag.lost.values())) + ", and from when on more may be" * any(
        gap.messages == UNKNOWN for gap in bag.gaps
    )
    return f"| {stall:g} | {published} | {recorded} | {published - recorded} | {told} |"


def _type(source: Source) -> str:
    kind = source.publisher.msg_type
    return f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"


def main() -> None:
    """Measure each duration of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seconds", type=float, nargs="*", default=[1.0, 3.0, 10.0, 30.0])
    durations = parser.parse_args().seconds
    base = {name: value for name, value in os.environ.items() if name != "ROS_DOMAIN_ID"}
    use_dds_profile()
    with tempfile.TemporaryDirectory(prefix="tactile_stall_") as name:
        environment = ros_environment(Path(name), base)
        rclpy.init(domain_id=environment.domain_id)
        node = rclpy.create_node("stall", namespace=ARM)
        print("| stopped s | published | recorded | missing | told by the bag |")
        print("| --- | --- | --- | --- | --- |")
        for number, stall in enumerate(durations):
            folder = Path(name) / str(number)
            folder.mkdir()
            group = ProcessGroup(grace_s=30.0, kill_after_s=5.0)
            try:
                print(measure(node, group, dict(environment.variables), folder, stall), flush=True)
            finally:
                group.close()
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
