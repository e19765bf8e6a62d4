"""Why a recorded run ended: by the controller, by the launch, by the silence of one of them."""

from types import SimpleNamespace

import numpy as np
import pytest

from tactile_base.node_topics import LAUNCH_LOG
from tactile_base.process_limits import OVERLOADED
from tactile_base.topics import CONTROLLER_STATUS, DIAGNOSTICS, ROSOUT
from tactile_records.runs.ending import ending
from tactile_records.runs.record import CommandSeries, RunRecord

SECOND = 10**9
START = 1_000 * SECOND
TOPIC = CONTROLLER_STATUS.of("arm").name
SILENCE = "nothing was heard of its controller for the last 4.1 s"


class Bag:
    """Ten seconds of what nodes said: (topic, s since its start, message)."""

    complete, problem = True, ""

    def __init__(self, *said):
        self.said = [
            (topic, SimpleNamespace(received_ns=START + int(at * SECOND)), message)
            for topic, at, message in said
        ]
        self.messages = [SimpleNamespace(received_ns=START + at * SECOND) for at in (0, 10)]

    def decoded(self, topic):
        return [(recorded, message) for name, recorded, message in self.said if name == topic]


def report(at, *statuses):
    status = [SimpleNamespace(name=name, message=text, level=level) for name, text, level in statuses]
    return DIAGNOSTICS.name, at, SimpleNamespace(status=status)


def end_of(*rows, said=()):
    """How a run of two goals ended with a status each 0.1 s from each row's time (s) to that of the next."""
    ends = [row[0] for row in rows[1:]] + [10.0]
    statuses = [
        (TOPIC, at, SimpleNamespace(phase=phase, goal=goal, reason=reason))
        for (begin, phase, goal, reason), end in zip(rows, ends, strict=True)
        for at in (np.arange(begin, end, 0.1) if phase else ())
    ]
    bag = Bag(*statuses, *said)
    record = RunRecord(goals=["first", "second"])
    record.command = CommandSeries(
        np.array([recorded.received_ns for _, recorded, _ in bag.said[: len(statuses)]]),
        phase=np.array([status.phase for _, _, status in statuses]),
        goal=np.array([status.goal for _, _, status in statuses]),
    )
    return ending(bag, record)


def test_a_run_that_reached_all_goals_has_no_reason_and_no_complaints():
    rows = (0.0, "follow", 0, ""), (4.0, "done", 0, ""), (5.0, "follow", 1, ""), (9.0, "done", 1, "")
    result = end_of(*rows, said=[report(8.9, ("/arm/filter", "late", 1))])
    assert (result["succeeded"], result["reason"], result["complaints"]) == (True, "", [])


def test_what_the_controller_said_is_the_reason_and_what_was_said_about_then_is_told():
    said = [
        report(1.0, ("/arm/camera", "gain is 4", 1)),
        report(5.9, ("/arm/estimator", "without contrast", 2), ("/arm/filter", "active", 0)),
        report(6.1, ("/arm/estimator", "without contrast", 2)),
        report(7.5, ("/arm/filter", "ends", 1)),
        (DIAGNOSTICS.name, 6.1, SimpleNamespace(other="type")),
    ]
    old = "belief is old"
    rows = (0.0, "done", 0, ""), (4.0, "follow", 1, ""), (6.0, "stopping", 1, old), (7.0, "failed", 1, old)
    result = end_of(*rows, said=said)
    assert not result["succeeded"]
    assert result["reason"] == "goal second was not reached: belief is old"
    assert result["complaints"] == ["/arm/estimator: without contrast"]


def test_the_launch_says_what_no_node_could_know():
    note = SimpleNamespace(name=LAUNCH_LOG, msg="node /arm/filter was killed by SIGKILL\n    its log")
    rows = (0.0, "follow", 0, ""), (6.5, "retreat", 0, "cancelled")
    reason = end_of(*rows, said=[(ROSOUT.name, 6.5, note)])["reason"]
    assert reason == "goal first was not reached: node /arm/filter was killed by SIGKILL"
    reason = end_of((0.0, "idle", 0, ""), said=[(ROSOUT.name, 6.5, note)])["reason"]
    assert reason.endswith("it was not begun: node /arm/filter was killed by SIGKILL")


def test_that_the_machine_was_overloaded_is_a_complaint_and_no_reason():
    said = f"{OVERLOADED}: its cores were in use for 98% of 3 s lately"
    note = SimpleNamespace(name=LAUNCH_LOG, msg=said)
    rows = (0.0, "follow", 0, ""), (6.5, "failed", 0, "pose is 143 ms old")
    complaint = report(6.4, ("/arm/filter", "late", 1))
    result = end_of(*rows, said=[complaint, (ROSOUT.name, 7.5, note)])
    assert result["reason"] == "goal first was not reached: pose is 143 ms old"
    assert result["complaints"] == ["/arm/filter: late", said]


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        ([(0.0, "follow", 0, "")], "the recording ends in its phase 'follow'"),
        ([(0.0, "follow", 0, ""), (6.0, "", 0, "")], SILENCE),
        ([(0.0, "idle", 0, "")], "it was not begun"),
    ],
)
def test_without_a_word_the_silence_is_told(rows, reason):
    assert end_of(*rows)["reason"] == f"goal first was not reached: {reason}"
