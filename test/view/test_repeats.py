"""What is told again and again: one event, one mark on the time line, and the overload in words."""

import re

import pytest
from cell_messages import START, blank, packed

from tactile_base import topics
from tactile_records.runs.record import Event
from tactile_view.cell_state import CellState
from tactile_view.recording_page import listed, timeline
from tactile_view.repeats import repeats
from tactile_view.words import events_in_words, overload_in_words

SECOND = 1_000_000_000


def at(seconds: float, kind: str, text: str) -> Event:
    return Event(START + round(seconds * SECOND), kind, text)


def overload(seconds: int) -> list[Event]:
    """Once a second, logged and in diagnostics, with another number each time."""
    behind = "cannot hold 100 steps a second: {} exposures left out so far"
    kinds = (("warning", "sim: "), ("diagnostics", "/sim: "))
    return [at(s, kind, name + behind.format(s)) for s in range(seconds) for kind, name in kinds]


def test_what_differs_in_numbers_alone_is_one_with_its_count_and_newest_text():
    events = sorted([*overload(60), at(20.5, "phase", "arm: follow")])
    first, phase = repeats(events)
    assert (first.times, first.last_ns - first.first_ns) == (60, 59 * SECOND)
    assert first.words.startswith("diagnostics (60 times): sim: cannot hold 100 steps a second: 59 exposures")
    assert listed([first, phase], START)[1] == "20.50 s phase: arm: follow"


def test_after_a_pause_it_is_told_anew_and_changes_are_each_their_own():
    again = [at(0.0, "warning", "a 1"), at(9.0, "warning", "a 2"), at(9.1, "refused", "a 2")]
    assert [event.times for event in repeats(again)] == [1, 1, 1]
    others = [at(0.0, "arm", "arm_1: fault"), at(0.1, "arm", "arm_2: fault"), at(0.2, "arm", "arm3: fault")]
    assert [event.text for event in repeats(others)] == [event.text for event in others]
    changes = [at(s, "parameter", f"/arm/controller task.speed = 0.0{s}") for s in range(5)]
    assert [event.text for event in repeats(changes)] == [event.text for event in changes]


def test_an_overload_leaves_the_time_line_free_for_what_else_happened():
    bar = timeline(repeats([*overload(300), at(299.5, "phase", "arm: done")]), START, 300.0)
    full = re.findall(r"height:100%;left:([\d.]+)%", bar)
    assert [float(left) for left in full] == pytest.approx([99.8, 0.0])
    assert re.findall(r"height:3px;left:0.00%;width:([\d.]+)%", bar) == ["99.70"] and "300 times" in bar


def test_the_state_says_who_is_overloaded_and_no_longer_than_that_lasts():
    state = CellState()

    def logged(seconds: int, text: str) -> None:
        ns = START + seconds * SECOND
        log = packed(topics.ROSOUT.type, level=30, name="arm.sim", msg=text)
        state.take(topics.ROSOUT.name, topics.ROSOUT.type, log, ns)

    logged(0, "a camera's frame refused")
    assert overload_in_words(state) == ""
    logged(1, "cannot hold 100 steps a second: 3 exposures left out so far")
    assert "overloaded</b>: arm.sim had too little time" in overload_in_words(state)
    logged(9, "a camera's frame refused")
    assert overload_in_words(state) == ""
    assert "8.0 s ago, warning: arm.sim: cannot hold" in events_in_words(state)
    status = blank(topics.DIAGNOSTICS.type, "diagnostic_msgs/msg/DiagnosticStatus")
    status.level, status.name, status.message = 1, "/recorder", "held up for 2.1 s"
    told = packed(topics.DIAGNOSTICS.type, status=[status])
    state.take(topics.DIAGNOSTICS.name, topics.DIAGNOSTICS.type, told, START + 10 * SECOND)
    assert "recorder had" in overload_in_words(state)
