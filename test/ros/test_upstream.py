"""Why an input is missing: the first of the nodes on the way to it that complains anew."""

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.serialization import serialize_message

from tactile_ros import colleagues
from tactile_ros.colleagues import Upstream

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class Node:
    """Stands for a controller's."""

    def get_namespace(self) -> str:
        return "/arm"

    def subscribe(self, message_type, topic, callback, *rest, **options) -> None:
        self.hear = callback


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(colleagues.time, "monotonic", lambda: now[0])
    return now


@pytest.fixture
def node(clock):
    return Node()


@pytest.fixture
def upstream(node):
    return Upstream(node)


def say(node, name: str, message: str, level=WARN) -> None:
    status = DiagnosticStatus(name=name, message=message, level=level)
    node.hear(serialize_message(DiagnosticArray(status=[status])))


def test_the_first_on_the_way_is_named_whoever_spoke_first(node, upstream):
    say(node, "/arm/filter", "contact/presence: no message for 0.31 s")
    say(node, "/arm/camera", "the device is gone", ERROR)
    assert upstream.cause == "/arm/camera: the device is gone"


def test_what_was_complained_about_for_long_is_not_the_cause_of_what_is_new(node, upstream, clock):
    for _ in range(8):
        say(node, "/arm/camera", f"gain: {clock[0]} was asked, the device keeps 4")
        clock[0] += 1.0
    assert upstream.cause.startswith("/arm/camera: gain")  # there is no other
    say(node, "/arm/estimator", "tactile/image refused: without contrast")
    assert upstream.cause == "/arm/estimator: tactile/image refused: without contrast"


def test_a_complaint_ends_with_the_next_report_that_has_none(node, upstream):
    say(node, "/arm/estimator", "images lost")
    say(node, "/arm/estimator", "active", OK)
    assert upstream.cause == ""


@pytest.mark.parametrize("state", ["inactive", "unconfigured"])
def test_a_node_that_was_deactivated_is_named(node, upstream, state):
    say(node, "/arm/filter", "contact/presence: no message for 0.31 s")
    say(node, "/arm/arm", state, OK)
    assert upstream.cause == f"/arm/arm: it is {state}"


def test_other_arms_and_other_nodes_are_not_listened_to(node, upstream):
    say(node, "/other/camera", "the device is gone")
    say(node, "/arm/recorder", "the disk is full")
    assert upstream.cause == ""


def test_single_images_that_were_lost_are_no_reason_for_none_at_all(node, upstream):
    say(node, "/arm/estimator", "tactile/image: 115 lost so far, 1 just now")
    assert upstream.cause == ""
    say(node, "/arm/estimator", "tactile/image: 115 lost so far, 1 just now; the model is gone")
    assert upstream.cause == "/arm/estimator: the model is gone"


def test_a_node_that_says_nothing_any_more_is_named(node, upstream, clock):
    say(node, "/arm/estimator", "active", OK)
    say(node, "/arm/filter", "active", OK)
    clock[0] += 1.0
    say(node, "/arm/filter", "contact/estimate: no message for 0.31 s")
    assert upstream.cause == "/arm/filter: contact/estimate: no message for 0.31 s"
    clock[0] += 0.3
    assert upstream.cause == "/arm/estimator has not been heard of for 1.3 s"
