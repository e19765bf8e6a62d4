"""Whether the arm still follows, and still says so."""

import pytest

from tactile_msgs.msg import ArmStatus
from tactile_ros import arm_attention
from tactile_ros.arm_attention import NONE, SILENT, ArmAttention


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


def hear(attention, clock, seconds, **status) -> str:
    """Take a status every 0.1 s, as an arm's node sends them; the trouble at the end."""
    for _ in range(round(seconds / 0.1)):
        clock[0] += 0.1
        attention.see(ArmStatus(**status), commands=True)
    return attention.trouble


def test_refusals_are_trouble_after_a_second_and_only_those_of_ones_own_commands(clock):
    attention = ArmAttention("me")
    refused = {"refused": "its stamp is 3.2 s old", "refused_source": "me"}
    assert hear(attention, clock, 0.9, **refused) == ""
    assert hear(attention, clock, 0.1) == ""  # quick resets: what is over counts no longer
    assert hear(attention, clock, 0.9, **refused) == ""
    assert hear(attention, clock, 0.3, **refused) == "the arm refuses its commands: its stamp is 3.2 s old"
    assert hear(attention, clock, 0.1) == ""
    assert hear(attention, clock, 3.0, **{**refused, "refused_source": "somebody"}) == ""


@pytest.mark.parametrize("age", [NONE, 1.5])
def test_commands_that_do_not_arrive_are_trouble(clock, age):
    attention = ArmAttention("me")
    assert hear(attention, clock, 0.9, owner="me", command_age=age) == ""
    told = hear(attention, clock, 0.3, owner="me", command_age=age)
    assert told == "the arm has heard no command for 1 s: they do not arrive"
    assert hear(attention, clock, 0.1, owner="me", command_age=0.01) == ""
    attention.see(ArmStatus(owner="me", command_age=age), commands=False)  # none were sent
    assert attention.trouble == ""
