"""The recorder: what is published is in the bag, or told as lost, with number and time."""

import os
import shutil
import signal

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import TwistStamped
from rclpy.action import ActionServer
from tf2_msgs.msg import TFMessage

from tactile_base import topics
from tactile_msgs.action import RunTask
from tactile_records.bags.contents import UNKNOWN
from tactile_records.bags.reader import read_bag
from tactile_ros import qos
from tactile_ros.conversions import transform_stamped

RECORDER = "tactile_ros.nodes.recorder_node"
FRAME = TFMessage(transforms=[transform_stamped(5, "arm/base", "arm/tool", np.eye(4))])
TOPICS = ["/tf tf2_msgs/msg/TFMessage reliable", "/arm/command/twist geometry_msgs/msg/TwistStamped reliable"]
FULL_DISK = """
import resource
from tactile_ros.run_nodes import run
from tactile_ros.nodes.recorder_node import RecorderNode

class OnAFullDisk(RecorderNode):
    def activate(self):
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))  # the system refuses what goes beyond

raise SystemExit(run(OnAFullDisk))
"""

FULL_AT_THE_END = """
import resource
from tactile_ros.run_nodes import run
from tactile_ros.nodes.recorder_node import RecorderNode

class OnADiskThatFillsAtItsClose(RecorderNode):
    def cleanup(self):
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))  # enough for the log of this process
        super().cleanup()

raise SystemExit(run(OnADiskThatFillsAtItsClose))
"""

SLOW_DISK = """
import time
from pathlib import Path
from rclpy.qos import QoSProfile
from tactile_ros.run_nodes import run
from tactile_ros.nodes import recorder_node

class OnASlowDisk(recorder_node.RecorderNode):
    def _write(self, *arguments):
        Path("{gate}.reached").touch()
        while not Path("{gate}").exists():
            time.sleep(0.01)
        super()._write(*arguments)

recorder_node.recorder_profile = lambda topic: QoSProfile(depth=100)  # soon full
raise SystemExit(run(OnASlowDisk))
"""


@pytest.fixture
def record(graph, tmp_path):
    """Starts a recorder, stops it in its tracks, has one topic published, and lets it go on."""

    def start(message, topic: str, profile, count: int):
        process = graph.start(RECORDER, {"bag": str(tmp_path / "bag"), "topics": TOPICS})
        publisher = graph.publisher(type(message), topic, profile)
        publisher.publish(message)
        graph.wait_for_count("recorder", "messages")
        os.kill(process.pid, signal.SIGSTOP)
        try:
            for _ in range(count - 2):
                publisher.publish(message)
        finally:
            os.kill(process.pid, signal.SIGCONT)
        graph.wait_for_count("recorder", "messages", 2)  # it goes on
        publisher.publish(message)

    return start


def counts(report) -> tuple[int, int]:
    """How many messages were recorded and lost."""
    return int(report.values.get("messages", 0)), int(report.values.get("/tf messages lost", 0))


@pytest.mark.parametrize(
    ("message", "topic", "profile"),
    [(FRAME, "/tf", qos.TF), (TwistStamped(), "/arm/command/twist", qos.COMMAND)],
)
def test_a_recorder_that_is_held_up_loses_nothing_of_what_our_nodes_publish(
    graph, record, tmp_path, message, topic, profile
):
    record(message, topic, qos.writer_profile(profile), count=10_000)
    assert counts(graph.wait_for_count("recorder", "messages", 10_000)) == (10_000, 0)
    assert graph.stop(RECORDER) == 0
    bag = read_bag(tmp_path / "bag")
    assert bag.complete and bag.counts[topic] == 10_000 and bag.lost == {}


def test_what_a_recorder_loses_is_told_in_diagnostics_in_the_log_and_in_the_bag(graph, record, tmp_path):
    """Of a publisher that keeps less, as those of other packages do."""
    record(FRAME, "/tf", qos.TF, count=10_000)
    report = graph.wait_for_report("recorder", lambda report: sum(counts(report)) == 10_000)
    recorded, lost = counts(report)
    assert recorded >= qos.TF.depth and lost > 0
    assert graph.stop(RECORDER) == 0
    bag = read_bag(tmp_path / "bag")
    assert bag.counts["/tf"] == recorded and bag.lost == {"/tf": lost} and not bag.complete
    assert f"/tf: {lost} of 10000 messages were published and not recorded" in bag.problem
    published = [message.published_ns for message in bag.messages]
    for gap in bag.gaps:  # between two messages that are in the bag
        assert published.index(gap.before_ns) == published.index(gap.after_ns) + 1
    assert any("/tf" in r.message and "known to be lost" in r.message for r in graph.reports("recorder"))
    assert f"{lost} lost" in graph.log(RECORDER).read_text()


def test_a_recorder_that_is_asked_to_end_right_after_it_was_held_up_has_all_or_says_so(graph, tmp_path):
    process = graph.start(RECORDER, {"bag": str(tmp_path / "bag"), "topics": TOPICS})
    publisher = graph.publisher(TFMessage, "/tf", qos.writer_profile(qos.TF))
    published = []

    def publish() -> None:
        publisher.publish(FRAME)
        published.append(FRAME)

    graph.every(0.002, 0.5, publish)
    os.kill(process.pid, signal.SIGSTOP)
    graph.every(0.002, 3.0, publish)
    os.kill(process.pid, signal.SIGCONT)
    assert graph.stop(RECORDER) == 0
    bag = read_bag(tmp_path / "bag")
    assert bag.counts["/tf"] == len(published) or not bag.complete


def test_of_a_publisher_that_ends_while_the_recorder_is_held_up_the_bag_says_from_when_on(graph, tmp_path):
    process = graph.start(RECORDER, {"bag": str(tmp_path / "bag"), "topics": TOPICS})
    publisher = graph.publisher(TFMessage, "/tf", qos.writer_profile(qos.TF))
    graph.every(0.02, 1.0, lambda: publisher.publish(FRAME))
    graph.wait_for_count("recorder", "messages", 20)
    os.kill(process.pid, signal.SIGSTOP)
    graph.every(0.02, 2.0, lambda: publisher.publish(FRAME))
    graph.node.destroy_publisher(publisher)
    os.kill(process.pid, signal.SIGCONT)
    graph.wait_for_count("recorder", "times held up")
    assert graph.stop(RECORDER) == 0
    bag = read_bag(tmp_path / "bag")
    (gap,) = bag.gaps
    assert (gap.topic, gap.messages) == ("/tf", UNKNOWN) and not bag.complete
    assert gap.after_ns == max(message.published_ns for message in bag.messages)
    assert "may be missing: the recorder was held up" in bag.problem


def test_messages_that_a_slow_disk_makes_overflow_the_recorders_queue_are_told(graph, tmp_path):
    parameters = {"bag": str(tmp_path / "bag"), "topics": TOPICS}
    graph.start_code("slow", SLOW_DISK.format(gate=tmp_path / "gate"), parameters)
    publisher = graph.publisher(TFMessage, "/tf", qos.writer_profile(qos.TF))
    publisher.publish(FRAME)
    assert graph.wait((tmp_path / "gate.reached").exists)  # numbers tell what is lost after the first
    for _ in range(999):
        publisher.publish(FRAME)
    (tmp_path / "gate").touch()
    published = 1000
    for _ in graph.ticks(0.2):  # by the number of a later one the recorder sees what is missing
        if any(sum(counts(report)) >= 1000 for report in graph.reports("recorder")):
            break
        publisher.publish(FRAME)
        published += 1
    report = graph.wait_for_report("recorder", lambda report: sum(counts(report)) == published)
    assert graph.stop("slow") == 0
    bag = read_bag(tmp_path / "bag")
    assert (bag.counts["/tf"], bag.lost["/tf"]) == counts(report) and not bag.complete


def test_a_bag_shows_why_a_goal_ended(graph, tmp_path):
    """What its action publishes, and what nodes log, read by the definitions in the bag."""
    recorded = [topics.ROSOUT, topics.TASK_STATUS.of("arm"), topics.TASK_FEEDBACK.of("arm")]
    texts = [f"{topic.name} {topic.type} {topic.qos}" for topic in recorded]
    graph.start(RECORDER, {"bag": str(tmp_path / "bag"), "topics": texts})

    def refuse(goal):
        goal.publish_feedback(RunTask.Feedback(phase="approach", reason="no surface was found"))
        graph.node.get_logger().error("the goal was not reached")
        goal.abort()
        return RunTask.Result()

    server = ActionServer(graph.node, RunTask, topics.RUN_TASK, refuse)
    goal = graph.action(RunTask, topics.RUN_TASK).send_goal_async(RunTask.Goal())
    assert graph.wait(goal.done)

    def ended() -> bool:
        if (tmp_path / "bag" / "bag_0.mcap").stat().st_size < 100:
            return False  # nothing was flushed so far
        bag = read_bag(tmp_path / "bag")  # while it is being written
        log, status, feedback = ([m for _, m in bag.decoded(topic.name)] for topic in recorded)
        return (
            "the goal was not reached" in [line.msg for line in log]
            and GoalStatus.STATUS_ABORTED in [entry.status for m in status for entry in m.status_list]
            and [(m.feedback.phase, m.feedback.reason) for m in feedback]
            == [("approach", "no surface was found")]
        )

    assert any(ended() for _ in graph.ticks(0.2))
    server.destroy()


def test_a_full_disk_ends_the_recording_with_a_sentence_and_what_was_written_is_read(graph, tmp_path):
    parameters = {"bag": str(tmp_path / "bag"), "topics": TOPICS}
    process = graph.start_code("full", FULL_DISK, parameters)
    publisher = graph.publisher(TFMessage, "/tf", qos.TF)
    noise = np.random.default_rng(3)
    for _ in graph.ticks(0.002):
        pose = np.eye(4)
        pose[:3, 3] = noise.standard_normal(3)
        publisher.publish(TFMessage(transforms=[transform_stamped(5, "arm/base", "arm/tool", pose)]))
        if process.poll() is not None:
            break
    log = graph.log("full").read_text()
    assert process.returncode == 1 and "Traceback" not in log
    assert "the recording ends after" in log and "bag_0.mcap: cannot be written: File too large" in log
    bag = read_bag(tmp_path / "bag")
    assert "ends early" in bag.problem and bag.counts["/tf"] > 10


def test_a_disk_that_fills_at_the_close_of_a_recording_ends_the_recorder_with_1_and_a_sentence(
    graph, tmp_path
):
    process = graph.start_code("full", FULL_AT_THE_END, {"bag": str(tmp_path / "bag"), "topics": TOPICS})
    process.send_signal(signal.SIGINT)
    assert graph.wait(lambda: process.poll() is not None)
    log = graph.log("full").read_text()
    assert process.returncode == 1 and "Traceback" not in log
    assert "the recording ends after 0 messages: " in log and "cannot be written: File too large" in log


def test_a_bag_that_is_deleted_while_it_is_written_ends_the_recording_with_a_sentence(graph, tmp_path):
    process = graph.start(RECORDER, {"bag": str(tmp_path / "bag"), "topics": TOPICS})
    shutil.rmtree(tmp_path / "bag")
    assert graph.wait(lambda: process.poll() is not None) and process.returncode == 1
    log = graph.log(RECORDER).read_text()
    assert "bag_0.mcap: cannot be written: it was deleted or moved while it was being written" in log
    assert "Traceback" not in log


def test_a_bag_that_cannot_be_created_is_an_error_that_names_it(graph, tmp_path):
    (tmp_path / "file").write_text("")
    process = graph.start(RECORDER, {"bag": str(tmp_path / "file" / "bag"), "topics": TOPICS}, wait=False)
    assert graph.wait(lambda: process.poll() is not None) and process.returncode == 1
    log = graph.log(RECORDER).read_text()
    assert "file/bag: cannot be created: Not a directory" in log and "Traceback" not in log


def test_topics_that_cannot_be_recorded_are_an_error_that_says_what_would_be_right(graph, tmp_path):
    listed = ["/tf tf2_msgs/msg/TFMessage quick"]
    process = graph.start(RECORDER, {"bag": str(tmp_path / "bag"), "topics": listed}, wait=False)
    assert graph.wait(lambda: process.poll() is not None) and process.returncode == 1
    assert (
        "must be 'NAME TYPE QOS' with a QOS of reliable, latched, sensor" in graph.log(RECORDER).read_text()
    )
