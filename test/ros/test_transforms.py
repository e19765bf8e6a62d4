"""What is heard on /tf and /tf_static is looked up by stamp, and the gate waits for it."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not in this environment: make, then . scripts/env.sh")

from messages import matrix_from_transform
from rclpy.serialization import serialize_message
from rclpy.time import Time
from tf2_msgs.msg import TFMessage

from tactile_filter.events import EventJoin
from tactile_geometry import se3
from tactile_geometry.transform_buffer import TransformInFuture, TransformInPast
from tactile_ros.conversions import transform_stamped
from tactile_ros.transforms import TransformGate, TransformListener

BASE, TOOL, SENSOR = "arm/base", "arm/tool", "arm/tactile_sensor"
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
PERIOD = 8_333_333
LAST = START + 9 * PERIOD
TOOL_SENSOR = se3.exp(np.array([0.0, 0.0, 0.1, 0.0, 0.2, 0.0]))


def pose(k: float) -> np.ndarray:
    return se3.exp(np.array([0.3, 0.1, 0.2, 0.2, 0.1, -0.1]) + 0.01 * k)


def message(parent: str, child: str, stamp_ns: int = START, T: np.ndarray | None = None):
    return transform_stamped(stamp_ns, parent, child, np.eye(4) if T is None else T)


class Node:
    """Takes the part of `ManagedNode` towards the listener."""

    def __init__(self) -> None:
        self.receive: dict = {}
        self.counters: dict[str, int] = {}
        self.warnings: list[str] = []

    def subscribe(self, message_type, topic, callback, profile, always, raw) -> None:
        assert raw
        self.receive[topic] = callback

    def timer(self, period, callback) -> None:
        """Nobody calls it here."""

    def count(self, what: str) -> None:
        self.counters[what] = self.counters.get(what, 0) + 1

    def warn(self, key: str, text: str) -> None:
        self.warnings.append(text)

    def check_stamp(self, stamp_ns: int) -> None:
        """The clock of this node has no limit."""

    def send(self, *sent) -> None:
        self.receive["/tf"](serialize_message(TFMessage(transforms=list(sent))))


@pytest.fixture
def listening():
    node, jumps = Node(), []
    listener = TransformListener(node, on_jump=jumps.append)
    node.receive["/tf_static"](
        serialize_message(TFMessage(transforms=[message(TOOL, SENSOR, 0, TOOL_SENSOR)]))
    )
    for k in range(10):
        node.send(message(BASE, TOOL, START + k * PERIOD, pose(k)))
    return SimpleNamespace(node=node, listener=listener, jumps=jumps)


@pytest.mark.parametrize("k", [0, 4, 9])
def test_what_was_heard_is_found_at_its_stamp_and_the_other_way_as_its_inverse(listening, k):
    stamp_ns, expected = START + k * PERIOD, pose(k) @ TOOL_SENSOR
    np.testing.assert_allclose(listening.listener.lookup(BASE, SENSOR, stamp_ns), expected, atol=1e-14)
    found = listening.listener.lookup(SENSOR, BASE, stamp_ns)
    np.testing.assert_allclose(found, se3.inverse(expected), atol=1e-14)


def test_the_newest_transform_comes_with_its_stamp(listening):
    stamp_ns, T = listening.listener.newest(BASE, SENSOR)
    assert stamp_ns == LAST
    np.testing.assert_allclose(T, pose(9) @ TOOL_SENSOR, atol=1e-14)


def test_a_stamp_of_zero_never_gets_the_newest_transform(listening):
    with pytest.raises(TransformInPast):
        listening.listener.lookup(BASE, SENSOR, 0)


def test_a_leading_slash_is_no_part_of_a_name(listening):
    listening.node.send(message("/" + BASE, "/camera"))
    np.testing.assert_allclose(listening.listener.lookup(BASE, "camera", START), np.eye(4), atol=1e-15)


@pytest.mark.parametrize("parent, child", [(BASE, ""), ("", TOOL), (BASE, "/"), (TOOL, TOOL), (SENSOR, BASE)])
def test_links_that_make_no_tree_are_refused_and_leave_it_as_it_was(listening, parent, child):
    listening.node.send(message(parent, child, LAST))
    assert listening.node.counters == {"transforms refused": 1}
    T = listening.listener.lookup(BASE, SENSOR, LAST)
    np.testing.assert_allclose(T, pose(9) @ TOOL_SENSOR, atol=1e-14)


@pytest.mark.parametrize(
    "part, axis, value",
    [
        ("translation", "x", np.nan),
        ("translation", "x", np.inf),
        ("rotation", "w", 0.0),
        ("rotation", "w", 1.002),
        ("rotation", "w", np.nan),
    ],
)
def test_a_transform_that_is_none_is_refused_and_the_newest_stays(listening, part, axis, value):
    broken = message(BASE, TOOL, LAST + PERIOD)
    setattr(getattr(broken.transform, part), axis, value)
    listening.node.send(broken)
    assert listening.node.counters == {"transforms refused": 1}
    assert listening.listener.newest(BASE, SENSOR)[0] == LAST


def test_a_transform_that_is_refused_is_no_jump(listening):
    broken = message(BASE, TOOL, START - SECOND)
    broken.transform.rotation.w = 0.0
    listening.node.send(broken)
    assert listening.jumps == []
    np.testing.assert_allclose(listening.listener.lookup(BASE, TOOL, LAST), pose(9), atol=1e-14)


def test_lookups_are_those_of_tf2(listening):
    """Between stamps to within the arc that tf2's straight line leaves out."""
    reason = "tf2_ros is not installed: no wheel of it exists, a ROS 2 installation has it"
    tf2_ros = pytest.importorskip("tf2_ros", reason=reason)
    buffer = tf2_ros.Buffer()
    buffer.set_transform_static(message(TOOL, SENSOR, 0, TOOL_SENSOR), "test")
    for k in range(10):
        buffer.set_transform(message(BASE, TOOL, START + k * PERIOD, pose(k)), "test")
    for fraction, tolerance in ((0.0, 1e-14), (0.3, 3e-5), (0.5, 3e-5)):
        stamp_ns = START + 3 * PERIOD + round(fraction * PERIOD)
        for frames in ((BASE, SENSOR), (SENSOR, BASE), (TOOL, SENSOR)):
            expected = buffer.lookup_transform(*frames, Time(nanoseconds=stamp_ns))
            found = listening.listener.lookup(*frames, stamp_ns)
            np.testing.assert_allclose(found, matrix_from_transform(expected.transform), atol=tolerance)
    for stamp_ns in (START - 1, LAST + 1):
        with pytest.raises(tf2_ros.ExtrapolationException):
            buffer.lookup_transform(BASE, SENSOR, Time(nanoseconds=stamp_ns))
        with pytest.raises((TransformInPast, TransformInFuture)):
            listening.listener.lookup(BASE, SENSOR, stamp_ns)
    newest_ns = buffer.get_latest_common_time(BASE, SENSOR).nanoseconds
    assert newest_ns == listening.listener.newest(BASE, SENSOR)[0]


def test_a_jump_back_is_reported_and_only_the_static_transforms_survive_it(listening):
    listening.node.send(message(BASE, TOOL, START - SECOND))
    assert listening.jumps == ["/tf: time jumped back by 1.075 s in the transforms of 'arm/tool'"]
    np.testing.assert_allclose(
        listening.listener.lookup(BASE, SENSOR, START - SECOND), TOOL_SENSOR, atol=1e-15
    )
    with pytest.raises(TransformInFuture):
        listening.listener.lookup(BASE, SENSOR, START)


def test_a_transform_that_was_overtaken_is_no_jump(listening):
    listening.node.send(message(BASE, TOOL, LAST + 3 * PERIOD, pose(12)))
    listening.node.send(message(BASE, TOOL, LAST + 1 * PERIOD, pose(10)))
    assert listening.jumps == []
    T = listening.listener.lookup(BASE, TOOL, LAST + 1 * PERIOD)
    np.testing.assert_allclose(T, pose(10), atol=1e-14)


def test_a_transform_that_cannot_be_used_is_counted_and_the_others_of_its_message_are_kept(listening):
    listening.node.send(message(SENSOR, BASE, LAST), message(BASE, "camera", LAST))
    assert listening.node.counters == {"transforms refused": 1}
    np.testing.assert_allclose(listening.listener.lookup(BASE, "camera", LAST), np.eye(4), atol=1e-15)


def test_a_frame_of_the_nodes_own_heard_late_is_no_second_jump():
    node, jumps = Node(), []
    TransformListener(node, on_jump=jumps.append, ignore=["contact"])
    node.send(message(BASE, TOOL, START))
    node.send(message(BASE, TOOL, START - 9 * SECOND))
    node.send(message(TOOL, "contact", START))
    node.send(message(TOOL, "contact", START - 9 * SECOND))
    assert jumps == ["/tf: time jumped back by 9.000 s in the transforms of 'arm/tool'"]


@pytest.fixture
def gate(listening):
    """A gate that waits an hour."""
    join, delivered, dropped = EventJoin(("a",)), [], []
    gate = TransformGate(
        listening.node,
        join,
        listening.listener,
        (BASE, SENSOR),
        timeout=lambda: 3600.0,
        deliver=lambda event, T: delivered.append((event.stamp_ns, T)),
        drop=lambda event, reason: dropped.append((event.stamp_ns, reason)),
    )
    return SimpleNamespace(gate=gate, join=join, delivered=delivered, dropped=dropped, **vars(listening))


def pump(gate, stamp_ns: int) -> None:
    gate.join.add("a", stamp_ns, None, time.monotonic_ns())
    gate.gate.pump()


def test_the_gate_waits_for_a_stamp_that_is_still_to_come(gate):
    pump(gate, LAST + PERIOD)
    assert gate.delivered == gate.dropped == []
    gate.node.send(message(BASE, TOOL, LAST + PERIOD, pose(10)))
    gate.gate.pump()
    assert [stamp_ns for stamp_ns, _ in gate.delivered] == [LAST + PERIOD]
    np.testing.assert_allclose(gate.delivered[0][1], pose(10) @ TOOL_SENSOR, atol=1e-14)


def test_the_gate_does_not_wait_for_a_stamp_that_has_passed_nor_hold_up_the_next_one(gate):
    pump(gate, START - 1)
    pump(gate, START)
    assert [stamp_ns for stamp_ns, _ in gate.dropped] == [START - 1]
    assert [stamp_ns for stamp_ns, _ in gate.delivered] == [START]


def test_the_gate_does_not_take_a_stamp_of_zero_for_the_newest(gate):
    pump(gate, 0)
    assert gate.delivered == [] and [stamp_ns for stamp_ns, _ in gate.dropped] == [0]
