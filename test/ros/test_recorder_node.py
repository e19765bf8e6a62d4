"""The recorder: what is published is in the bag, or counted as lost."""

import json
import os
import signal

import numpy as np
import pytest
from tf2_msgs.msg import TFMessage

from tactile_records.bags.reader import read_bag
from tactile_ros import qos
from tactile_ros.conversions import transform_stamped

RECORDER = "tactile_ros.nodes.recorder_node"
FRAME = TFMessage(transforms=[transform_stamped(5, "arm/base", "arm/tool", np.eye(4))])


@pytest.fixture
def record(graph, tmp_path):
    """Starts a recorder of /tf, stops it in its tracks, publishes so many messages, and lets it go on."""

    def start(profile, count: int):
        topics = ["/tf tf2_msgs/msg/TFMessage reliable"]
        process = graph.start(RECORDER, {"bag": str(tmp_path / "bag"), "topics": topics})
        publisher = graph.publisher(TFMessage, "/tf", profile)
        os.kill(process.pid, signal.SIGSTOP)
        try:
            for _ in range(count):
                publisher.publish(FRAME)
        finally:
            os.kill(process.pid, signal.SIGCONT)

    return start


def counts(report) -> tuple[int, int]:
    """How many messages were recorded and lost."""
    return int(report.values.get("messages", 0)), int(report.values.get("/tf messages lost", 0))


def test_a_recorder_that_is_held_up_loses_nothing_of_what_our_nodes_publish(graph, record, tmp_path):
    record(qos.writer_profile(qos.TF), count=10_000)
    assert counts(graph.wait_for_count("recorder", "messages", 10_000)) == (10_000, 0)
    assert graph.stop(RECORDER) == 0
    bag = read_bag(tmp_path / "bag")
    assert bag.complete and bag.counts == {"/tf": 10_000} and "messages_lost" not in bag.note


def test_what_a_recorder_loses_is_counted_in_diagnostics_and_in_the_bag(graph, record, tmp_path):
    """Of a publisher that keeps less, as those of other packages do."""
    record(qos.TF, count=10_000)
    report = graph.wait_for_report("recorder", lambda report: sum(counts(report)) == 10_000)
    recorded, lost = counts(report)
    assert recorded >= qos.TF.depth and lost > 0
    assert graph.stop(RECORDER) == 0
    bag = read_bag(tmp_path / "bag")
    assert bag.counts == {"/tf": recorded} and json.loads(bag.note["messages_lost"]) == {"/tf": lost}
    assert any(
        "/tf" in report.message and "lost so far" in report.message for report in graph.reports("recorder")
    )


def test_topics_that_cannot_be_recorded_are_an_error_that_says_what_would_be_right(graph, tmp_path):
    topics = ["/tf tf2_msgs/msg/TFMessage quick"]
    process = graph.start(RECORDER, {"bag": str(tmp_path / "bag"), "topics": topics}, wait=False)
    assert graph.wait(lambda: process.poll() is not None) and process.returncode == 1
    assert (
        "must be 'NAME TYPE QOS' with a QOS of reliable, latched, sensor" in graph.log(RECORDER).read_text()
    )
