"""Simulator, filter and controller together: a surface is followed; a part that falls silent stops the arm.

The sensor is an ideal one (its estimate is the noisy truth), so that these tests are about the graph.
"""

import signal

import numpy as np
import pytest
from ramp_cell import CONTROLLER, FILTER, RECORDER, SECOND, WHATEVER_THE_LOAD, Cell

from tactile_base.topics import ARM_TOPICS, TRUTH
from tactile_records.bags.reader import read_bag
from tactile_ros.conversions import ns_from_time

OUT_OF_ORDER = "ending before what the node works for has ended"


@pytest.fixture(scope="module")
def running(shared_graph, tmp_path_factory):
    """For all tests after which the graph is as it was; each goes on where the last one has left the ramp."""
    return Cell(shared_graph, tmp_path_factory.mktemp("cell"), length=0.04)


@pytest.fixture(scope="module")
def followed(running):
    """After a first goal, and its result."""
    return running, running.result(running.send())


@pytest.fixture
def cell(graph, tmp_path):
    """One of the test's own."""
    return Cell(graph, tmp_path)


def test_the_ramp_is_followed_at_depth_and_along_the_normal(followed):
    cell, result = followed
    assert result.success, result.reason
    started = next(ns_from_time(m.header.stamp) for m in cell.statuses if m.phase == "follow")
    ended = max(ns_from_time(m.header.stamp) for m in cell.statuses if m.phase == "follow")
    path = [m for m in cell.truths if started + SECOND // 2 < ns_from_time(m.header.stamp) < ended]
    depth_mm = np.array([m.depth for m in path]) * 1e3
    angle_deg = np.degrees([m.normal_angle for m in path])
    assert all(m.in_contact for m in path)
    assert np.sqrt(np.mean((depth_mm - 3.0) ** 2)) < 0.3
    assert np.sqrt(np.mean(angle_deg**2)) < 2.0


def test_each_exposure_is_answered_or_counted_as_dropped(followed):
    cell, _ = followed
    seen: dict[str, dict[int, int]] = {"camera": {}, "filter": {}, "controller": {}}
    for message in cell.latencies:
        for exposed, dropped in zip(message.exposed, message.dropped, strict=True):
            seen[message.stage][ns_from_time(exposed)] = dropped
    since = max(min(by_stamp) for by_stamp in seen.values())
    until = min(max(by_stamp) for by_stamp in seen.values())
    stamps = {stage: {s for s in by_stamp if since <= s <= until} for stage, by_stamp in seen.items()}
    assert len(stamps["camera"]) > 100
    assert stamps["filter"] == stamps["controller"]
    missing = stamps["camera"] - stamps["filter"]
    assert len(missing) <= seen["filter"][until] - seen["filter"][since]


def test_a_filter_that_pauses_brings_the_arm_to_rest_and_the_task_goes_on(running):
    handle = running.following()
    paused = running.graph.processes.children[FILTER].process
    paused.send_signal(signal.SIGSTOP)
    try:
        running.assert_at_rest_within(running.graph.now_ns(), 0.3)
    finally:
        paused.send_signal(signal.SIGCONT)
    result = running.result(handle)
    assert result.success, result.reason


def test_a_filter_that_stops_brings_the_arm_to_rest_and_the_task_ends_with_the_reason(running):
    handle = running.following()
    # longer than a loaded machine holds up the controller itself, which would be the reason then
    assert running.graph.set_parameter("controller", "watchdog.patience", 4.0).successful
    stopped = running.graph.processes.children[FILTER].process
    stopped.send_signal(signal.SIGSTOP)
    try:
        running.assert_at_rest_within(running.graph.now_ns(), 0.3)
        result = running.result(handle)
    finally:
        stopped.send_signal(signal.SIGCONT)
    assert not result.success and "belief" in result.reason and "limit" in result.reason
    patience = WHATEVER_THE_LOAD["watchdog.patience"]
    assert running.graph.set_parameter("controller", "watchdog.patience", patience).successful


def test_a_filter_that_is_asked_to_end_does_not_wait_for_a_controller_that_is_idle(running):
    assert running.graph.wait(lambda: not any(running.arms[-1].twist))
    assert running.graph.stop(FILTER) == 0
    assert OUT_OF_ORDER not in running.graph.log(FILTER).read_text()


def test_a_controller_that_is_killed_leaves_the_arm_at_rest_by_its_own_watchdog_and_holds_up_no_end(cell):
    cell.following()
    cell.graph.processes.children[CONTROLLER].process.kill()
    cell.assert_at_rest_within(cell.graph.now_ns(), 0.3)
    assert "no command for" in cell.arms[-1].reason
    assert cell.graph.stop(FILTER) == 0
    assert OUT_OF_ORDER not in cell.graph.log(FILTER).read_text()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_nodes_that_are_all_signalled_at_once_end_after_the_arm_has_left_the_surface(graph, tmp_path, number):
    topics = [topic.of("arm") for topic in (*ARM_TOPICS, TRUTH)]
    listed = [f"'{topic.name} {topic.type} {topic.qos}'" for topic in topics]
    cell = Cell(graph, tmp_path)
    graph.start(RECORDER, {"bag": tmp_path / "bag", "topics": listed}, namespace="")
    handle = cell.following()
    result = handle.get_result_async()
    graph.settle()
    children = graph.processes.children
    # whoever is signalled first: what the controller needs, or the controller itself
    order = list(children) if number == signal.SIGTERM else list(reversed(children))
    for name in order:
        children[name].process.send_signal(number)
    assert graph.wait(lambda: result.done() and all(c.process.poll() is not None for c in children.values()))
    assert [child.process.returncode for child in children.values()] == [0] * 4
    assert not result.result().result.success
    assert result.result().result.reason == f"the controller was asked to end by {number.name}"
    assert all(graph.log(name).read_text().count(OUT_OF_ORDER) == 0 for name in order)
    bag = read_bag(tmp_path / "bag")
    assert bag.complete, bag.problem
    touching = [truth.in_contact for _, truth in bag.decoded("/arm/sim/truth")]
    assert any(touching) and not touching[-1]
    *_, (_, last) = bag.decoded("/arm/command/request")
    assert not any(last.twist)
    ahead = [len(path.poses) for _, path in bag.decoded("/arm/controller/path")]
    assert any(ahead) and not ahead[-1], "where it leads is told until it has ended"


def test_a_second_signal_ends_a_controller_at_once_with_the_arm_at_rest_where_it_is(cell):
    cell.following()
    controller = cell.graph.processes.children[CONTROLLER]
    assert cell.graph.set_parameter("controller", "contact.retreat_speed", 0.001).successful
    controller.process.send_signal(signal.SIGINT)
    assert cell.graph.wait(lambda: cell.statuses[-1].phase == "retreat")
    for _ in cell.graph.ticks(0.1):
        controller.process.send_signal(signal.SIGINT)  # after a while it counts as a second one
        if f"a second signal: {OUT_OF_ORDER}" in controller.log.read_text():
            break
    cell.assert_at_rest_within(cell.graph.now_ns(), 0.25)
    assert cell.graph.wait(lambda: controller.process.poll() is not None)
    assert controller.process.returncode == 0
