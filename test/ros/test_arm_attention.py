"""Whether the arm still follows, and still says so."""

import pytest

from tactile_msgs.msg import ArmStatus
from tactile_ros import arm_attention
from tactile_ros.arm_attention import SILENT, ArmAttention


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(arm_attention.time, "monotonic", lambda: now[0])
    return now


def wait(attention, clock, seconds) -> str:
    """Ask all the time, as a node's timer does; the last answer."""
    answer = ""
    for _ in range(round(seconds / 0.1)):
        clock[0] += 0.1
        answer = attention.silence()
    return answer


def test_an_arm_that_was_never_heard_of_is_not_missed(clock):
    assert wait(ArmAttention("me"), clock, 10.0) == ""


def test_an_arm_that_says_nothing_any_more_is(clock):
    attention = ArmAttention("me")
    wait(attention, clock, 1.0)
    attention.see(ArmStatus(), commands=True)
    assert wait(attention, clock, SILENT - 0.1) == ""
    assert wait(attention, clock, 0.3) == "the arm's node has said nothing for 1.7 s: is it active?"
    attention.see(ArmStatus(), commands=True)
    assert attention.silence() == ""


def test_who_was_held_up_itself_does_not_blame_the_arm(clock):
    attention = ArmAttention("me")
    wait(attention, clock, 1.0)
    attention.see(ArmStatus(), commands=True)
    clock[0] += 30.0
    assert attention.silence() == ""
    assert wait(attention, clock, SILENT + 0.2) != ""
