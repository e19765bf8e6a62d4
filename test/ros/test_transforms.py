"""Both stores of transforms behave alike, and so do the listener and the gate on top of them."""

import importlib.util
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not in this environment: make, then . scripts/env.sh")

from rclpy.serialization import serialize_message
from tf2_msgs.msg import TFMessage

from tactile_filter import se3
from tactile_filter.events import EventJoin
from tactile_filter.transform_buffer import (
    TransformDisconnected,
    TransformInFuture,
    TransformInPast,
    TransformUnavailable,
)
from tactile_ros import transforms
from tactile_ros.cdr import transforms_from_bytes
from tactile_ros.conversions import MessageError, transform_stamped
from tactile_ros.transforms import OwnStore, Tf2Store, TransformGate, TransformListener

BASE, TOOL, SENSOR = "arm/base", "arm/tool", "arm/tactile_sensor"
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
PERIOD = 8_333_333
LAST = START + 9 * PERIOD
TOOL_SENSOR = se3.exp(np.array([0.0, 0.0, 0.1, 0.0, 0.2, 0.0]))


def fake_tf2_ros() -> ModuleType:
    path = Path(__file__).with_name("fake_tf2_ros.py")
    spec = importlib.util.spec_from_file_location("fake_tf2_ros", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(params=["own", "tf2"])
def kind(request, monkeypatch):
    """Which buffer `TransformListener` finds: tf2's is the real one where it is installed."""
    if request.param == "own":
        monkeypatch.setattr(transforms, "tf2_ros", None)
    elif transforms.tf2_ros is None:
        monkeypatch.setattr(transforms, "tf2_ros", fake_tf2_ros())
    return request.param


@pytest.fixture
def store(kind):
    """The sensor fixed to the tool, which has ten poses."""
    store = OwnStore() if kind == "own" else Tf2Store()
    put(store, transform_stamped(0, TOOL, SENSOR, TOOL_SENSOR), static=True)
    move(store, START)
    return store


def pose(k: float) -> np.ndarray:
    return se3.exp(np.array([0.3, 0.1, 0.2, 0.2, 0.1, -0.1]) + 0.01 * k)


def put(store, message, static: bool = False) -> None:
    (transform,) = transforms_from_bytes(serialize_message(TFMessage(transforms=[message])))
    store.put(transform, static)


def move(store, start_ns: int) -> None:
    for k in range(10):
        put(store, transform_stamped(start_ns + k * PERIOD, BASE, TOOL, pose(k)))


def message(parent: str, child: str, stamp_ns: int = START, T: np.ndarray | None = None):
    return transform_stamped(stamp_ns, parent, child, np.eye(4) if T is None else T)


# ---- stores ----


@pytest.mark.parametrize("k", [0, 4, 9])
def test_a_lookup_at_a_stamp_is_exact(store, k):
    np.testing.assert_allclose(
        store.lookup(BASE, SENSOR, START + k * PERIOD), pose(k) @ TOOL_SENSOR, atol=1e-14
    )


def test_a_lookup_the_other_way_is_the_inverse(store):
    np.testing.assert_allclose(
        store.lookup(SENSOR, BASE, START), se3.inverse(pose(0) @ TOOL_SENSOR), atol=1e-14
    )


def test_between_stamps_both_interpolate_to_within_the_curvature_of_one_period(store):
    T = store.lookup(BASE, TOOL, START + PERIOD // 2)
    np.testing.assert_allclose(T, se3.interpolate(pose(0), pose(1), 0.5), atol=3e-5)


def test_too_early_and_too_late_are_told_apart(store):
    with pytest.raises(TransformInPast, match="earlier"):
        store.lookup(BASE, SENSOR, START - 1)
    with pytest.raises(TransformInFuture, match=rf"newest is of {LAST} ns.*later"):
        store.lookup(BASE, SENSOR, LAST + 1)


@pytest.mark.parametrize("offset, error", [(-1, TransformInPast), (1, TransformInFuture)])
def test_past_and_future_are_told_apart_by_a_single_transform(store, offset, error):
    put(store, message(SENSOR, "tip", START + PERIOD))
    with pytest.raises(error):
        store.lookup(SENSOR, "tip", START + PERIOD + offset)


def test_a_stamp_of_zero_never_gets_the_newest_transform(store):
    with pytest.raises(TransformInPast):
        store.lookup(BASE, SENSOR, 0)


@pytest.mark.parametrize("stamp_ns", [0, START, LAST + SECOND])
def test_a_static_transform_holds_at_any_stamp(store, stamp_ns):
    np.testing.assert_allclose(store.lookup(TOOL, SENSOR, stamp_ns), TOOL_SENSOR, atol=1e-15)


def test_the_newest_has_the_stamp_of_the_link_that_lags(store):
    put(store, message(SENSOR, "tip", START + 2 * PERIOD))
    stamp_ns, T = store.newest(BASE, "tip")
    assert stamp_ns == START + 2 * PERIOD
    np.testing.assert_allclose(T, pose(2) @ TOOL_SENSOR, atol=1e-14)


def test_what_does_not_move_has_no_newest(store):
    with pytest.raises(TransformUnavailable, match="nothing moves"):
        store.newest(TOOL, SENSOR)


@pytest.mark.parametrize(
    "frames", [(BASE, "nix"), ("nix", SENSOR), (BASE, "leaf"), (BASE, ""), ("/" + BASE, TOOL)]
)
def test_unknown_and_unconnected_frames_are_disconnected(store, frames):
    put(store, message("other", "leaf"))
    with pytest.raises(TransformDisconnected):
        store.lookup(*frames, START)
    with pytest.raises(TransformDisconnected):
        store.newest(*frames)


def test_clearing_keeps_what_is_static_and_nothing_else(store):
    store.clear()
    np.testing.assert_allclose(store.lookup(TOOL, SENSOR, START), TOOL_SENSOR, atol=1e-15)
    with pytest.raises(TransformDisconnected):
        store.lookup(BASE, SENSOR, START)
    with pytest.raises(TransformDisconnected):
        store.newest(BASE, SENSOR)


def test_after_clearing_an_earlier_time_can_begin(store):
    store.clear()
    move(store, START - 100 * SECOND)
    assert store.newest(BASE, SENSOR)[0] == LAST - 100 * SECOND
    with pytest.raises(TransformInFuture):
        store.lookup(BASE, SENSOR, START)


def test_after_clearing_a_link_may_be_turned_around(store):
    store.clear()
    put(store, message(TOOL, BASE))
    np.testing.assert_allclose(store.lookup(TOOL, BASE, START), np.eye(4), atol=1e-15)


def test_a_leading_slash_is_no_part_of_a_name(store):
    put(store, message("/" + BASE, "/camera"))
    np.testing.assert_allclose(store.lookup(BASE, "camera", START), np.eye(4), atol=1e-15)


@pytest.mark.parametrize(
    "parent, child, text",
    [
        (BASE, "", "empty"),
        ("", TOOL, "empty"),
        (BASE, "/", "empty"),
        (TOOL, TOOL, "loop"),
        (SENSOR, BASE, "loop"),
    ],
)
def test_links_that_do_not_make_a_tree_are_refused_and_leave_it_as_it_was(store, parent, child, text):
    with pytest.raises(MessageError, match=text):
        put(store, message(parent, child, LAST))
    np.testing.assert_allclose(store.lookup(BASE, SENSOR, LAST), pose(9) @ TOOL_SENSOR, atol=1e-14)


@pytest.mark.parametrize("x", [np.nan, np.inf])
def test_a_translation_that_is_not_finite_is_refused(store, x):
    broken = np.eye(4)
    broken[0, 3] = x
    with pytest.raises(MessageError, match="finite"):
        put(store, message(BASE, TOOL, LAST + PERIOD, broken))
    assert store.newest(BASE, SENSOR)[0] == LAST


@pytest.mark.parametrize("w", [0.0, 1.002, 2.0, np.nan])
def test_a_quaternion_that_is_no_rotation_is_refused(store, w):
    broken = message(BASE, TOOL, LAST + PERIOD)
    broken.transform.rotation.w = w
    with pytest.raises(MessageError, match="norm 1"):
        put(store, broken)
    assert store.newest(BASE, SENSOR)[0] == LAST


# ---- listener and gate ----


class Node:
    """Takes the part of `ManagedNode` towards the listener."""

    def __init__(self) -> None:
        self.receive: dict = {}
        self.counters: dict[str, int] = {}

    def subscribe(self, message_type, topic, callback, profile, always, raw) -> None:
        assert raw
        self.receive[topic] = callback

    def timer(self, period, callback) -> None:
        """Nobody calls it here."""

    def count(self, what: str) -> None:
        self.counters[what] = self.counters.get(what, 0) + 1

    def warn(self, key: str, text: str) -> None:
        """Counted already."""

    def send(self, *sent) -> None:
        self.receive["/tf"](serialize_message(TFMessage(transforms=list(sent))))


@pytest.fixture
def listening(kind):
    node, jumps = Node(), []
    listener = TransformListener(node, on_jump=jumps.append)
    assert isinstance(listener.store, OwnStore if kind == "own" else Tf2Store)
    node.receive["/tf_static"](
        serialize_message(TFMessage(transforms=[message(TOOL, SENSOR, 0, TOOL_SENSOR)]))
    )
    for k in range(10):
        node.send(message(BASE, TOOL, START + k * PERIOD, pose(k)))
    return SimpleNamespace(node=node, listener=listener, jumps=jumps)


def test_a_jump_back_is_told_and_only_the_static_transforms_survive_it(listening):
    listening.node.send(message(BASE, TOOL, START - SECOND))
    assert listening.jumps == [pytest.approx(1.075, abs=1e-4)]
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


def test_a_frame_of_the_nodes_own_heard_late_is_no_second_jump(kind):
    node, jumps = Node(), []
    TransformListener(node, on_jump=jumps.append, ignore=["contact"])
    node.send(message(BASE, TOOL, START))
    node.send(message(BASE, TOOL, START - 9 * SECOND))
    node.send(message(TOOL, "contact", START))
    node.send(message(TOOL, "contact", START - 9 * SECOND))
    assert jumps == [pytest.approx(9.0)]


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
