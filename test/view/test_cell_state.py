"""What the page knows of a cell: kept from messages as bytes, bounded, and never ended by what is none."""

import numpy as np
import pytest
from cell_messages import DEPTH, GOAL, RATE, SHEAR, START, X_SF, messages, packed, sensor_pose, stamp
from hypothesis import given, strategies

from tactile_base import topics
from tactile_geometry import se3
from tactile_view.cell_state import WINDOW, CellState
from tactile_view.words import (
    estimate_in_words,
    events_in_words,
    latency_in_words,
    state_in_words,
    troubles_in_words,
)

OF_ARM = topics.STATE, topics.ARM_STATUS, topics.PATH, topics.LATENCY
FUZZED = {t.name: t.type for t in (topics.TF, topics.DIAGNOSTICS, *(t.of("arm") for t in OF_ARM))}


@pytest.fixture(scope="module")
def known() -> CellState:
    state = CellState()
    for message in messages(2.0):
        state.take(*message)
    return state


def test_the_newest_of_each_stream_is_what_was_said_last(known):
    arm = known.arms["arm"]
    np.testing.assert_allclose(arm.newest("pose")["T_base_sensor"], sensor_pose(2.0 - 1 / RATE), atol=1e-12)
    np.testing.assert_allclose(arm.newest("belief")["mean"], X_SF, atol=1e-12)
    np.testing.assert_allclose(arm.newest("estimate")["mean"], X_SF, atol=1e-12)
    assert arm.newest("truth")["T_fs"][2, 3] == DEPTH
    assert arm.controller.phase == "follow" and arm.image is not None
    assert arm.T_world_base[2, 3] == 0.5
    np.testing.assert_array_equal(arm.ahead, [GOAL])
    assert known.now_ns == START + round((2.0 * RATE - 1) / RATE * 1e9)


def test_phases_are_events_once_each(known):
    assert [event.text for event in known.events if event.kind == "phase"] == ["arm: approach", "arm: follow"]


def test_no_more_than_the_window_is_kept():
    state = CellState()
    for message in messages(WINDOW + 2.0):
        if message[0].endswith("arm/pose"):
            state.take(*message)
    rows = state.arms["arm"].streams["pose"]
    assert len(rows) == pytest.approx(WINDOW * RATE, abs=2)
    assert len(state.arms["arm"].path) == pytest.approx(120.0 / 0.5, rel=0.2), "a point each half millimetre"


def test_what_is_no_message_is_counted_and_nothing_is_lost(known):
    state = CellState()
    good = next(m for m in messages(0.1) if m[0] == "/arm/arm/pose")
    state.take(*good)
    state.take(good[0], good[1], good[2][:20], good[3])
    nan = packed(good[1], **stamp(START), pose__position__x=float("nan"), pose__orientation__w=1.0)
    state.take(good[0], good[1], nan, good[3])
    assert state.refused == {"/arm/arm/pose": 2} and len(state.arms["arm"].streams["pose"]) == 1
    assert "2 messages on /arm/arm/pose are none" in troubles_in_words(state)


@given(strategies.sampled_from(sorted(FUZZED)), strategies.binary(max_size=300))
def test_no_bytes_end_it(topic, data):
    state = CellState()
    state.take(topic, FUZZED[topic], data, START)
    state.take(topic, FUZZED[topic], b"\x00\x01\x00\x00" + data, START)


def test_in_words_it_says_units_and_nothing_is_markup(known):
    arm = known.arms["arm"]
    said = state_in_words(arm)
    assert "<b>surface_following</b> <i>east</i>: follow" in said and "commanded by /arm/controller" in said
    assert f"depth {1e3 * DEPTH:.2f} mm, shear {1e3 * SHEAR:.2f} mm" in said
    assert "+3.00" in estimate_in_words(arm) and "contact" in estimate_in_words(arm)
    state = CellState()
    data = packed(
        topics.CONTROLLER_STATUS.type,
        task="<script>alert(1)</script>",
        phase="{x}",
        reason="<b>",
        **stamp(START),
    )
    state.take("/arm/controller/status", topics.CONTROLLER_STATUS.type, data, START)
    for text in (state_in_words(state.arms["arm"]), events_in_words(state)):
        assert "<script>" not in text and "because <b>" not in text


def test_latency_is_told_by_stage_with_what_was_dropped():
    from tactile_view.cell_state import ArmState

    arm = ArmState("arm")
    assert latency_in_words(arm) == ""
    arm.latency = {"filter": [(0, 0.004), (1, 0.006)], "estimator": [(0, 0.002)]}
    arm.dropped = {"filter": 3}
    said = latency_in_words(arm)
    assert said.index("estimator") < said.index("filter") and ">5.0<" in said and ">3<" in said


def test_a_change_of_a_parameter_is_an_event_and_its_value_is_handed_on():
    from cell_messages import blank

    state, kind = CellState(), topics.PARAMETER_EVENTS.type
    changed = blank(kind, "rcl_interfaces/msg/Parameter")
    changed.name, changed.value.type, changed.value.double_value = "task.depth", 3, 0.004
    state.take(
        "/parameter_events", kind, packed(kind, node="/arm/controller", changed_parameters=[changed]), START
    )
    assert state.changed == {"/arm/controller": {"task.depth": 0.004}}
    assert "/arm/controller task.depth = 0.004" in events_in_words(state)


def test_the_mean_of_the_belief_is_where_the_feature_is(known):
    arm = known.arms["arm"]
    T_base_f = arm.newest("pose")["T_base_sensor"] @ arm.newest("belief")["mean"]
    np.testing.assert_allclose(T_base_f[:3, 2], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(se3.inverse(arm.newest("belief")["mean"])[2, 3], DEPTH, atol=1e-12)
