"""How a recorded run ended: which goals were reached, why one was not, what nodes complained about then."""

from __future__ import annotations

from typing import Any

from tactile_base.node_topics import LAUNCH_LOG
from tactile_base.stamps import SECOND_NS
from tactile_base.topics import DIAGNOSTICS, ROSOUT
from tactile_records.bags.contents import Bag
from tactile_records.runs.record import RunRecord

DONE, IDLE = "done", "idle"  # phases
CANCELLED = "cancelled"  # the reason of a goal that was
LEVEL_OK = 0  # of diagnostic_msgs/DiagnosticStatus
BEFORE, AFTER = 3.0, 0.5  # s about the end of a goal in which a complaint may say why
SILENT = 1.0  # s without a status after which a controller counts as gone: it has one in every step


def ending(bag: Bag, record: RunRecord) -> dict[str, Any]:
    """The result of a run (`RunRecord.result`), as far as the bag knows.

    The reason is what the controller said, or that it said nothing any more. `complaints` are those of all
    nodes about the end of the goal that was not reached, each once, in their order: "/arm/filter: ...".
    """
    result: dict[str, Any] = {"bag_complete": bag.complete, "complaints": []}
    if not bag.complete:
        result["bag_problem"] = bag.problem
    if bag.messages:
        result["wall_s"] = (bag.messages[-1].received_ns - bag.messages[0].received_ns) * 1e-9
    reached = [
        DONE in record.command.phase[record.command.goal == index] for index in range(len(record.goals))
    ]
    result["succeeded"] = bool(record.goals) and all(reached)
    result["reason"] = ""
    if not result["succeeded"] and record.goals:
        missed = reached.index(False)
        why, end_ns = _why(bag, record, missed)
        result["reason"] = f"goal {record.goals[missed]} was not reached" + (f": {why}" if why else "")
        result["complaints"] = _complaints(bag, end_ns)
    return result


def _why(bag: Bag, record: RunRecord, goal: int) -> tuple[str, int]:
    """Why a goal was not reached, and when that was known (ns)."""
    command = record.command
    rows = ((command.goal == goal) & (command.phase != IDLE)).nonzero()[0]
    if not len(rows):
        return "it was not begun", int(command.stamp_ns[-1]) if len(command) else 0
    reason, phase = str(command.reason[rows[-1]]), command.phase[rows[-1]]
    launcher = _launcher_said(bag)
    if launcher and reason in ("", CANCELLED):
        return launcher, int(command.stamp_ns[rows[-1]])
    if reason:
        said = rows[command.reason[rows] == reason]
        return reason, int(command.stamp_ns[said[0]])
    last_ns, heard_ns = int(command.stamp_ns[rows[-1]]), int(command.stamp_ns[-1])
    silence = (bag.messages[-1].received_ns - heard_ns) / SECOND_NS
    if silence > SILENT:
        return f"nothing was heard of its controller for the last {silence:.1f} s", last_ns
    return f"the recording ends in its phase '{phase}'", last_ns


def _launcher_said(bag: Bag) -> str:
    """Why the launch ended, where its nodes did not know it: one of them died, or somebody pressed Ctrl-C."""
    said = [message.msg for _, message in bag.decoded(ROSOUT.name) if message.name == LAUNCH_LOG]
    return str(said[-1]).splitlines()[0] if said else ""


def _complaints(bag: Bag, end_ns: int) -> list[str]:
    """What nodes complained about at that time, once each."""
    first, last = end_ns - BEFORE * SECOND_NS, end_ns + AFTER * SECOND_NS
    found: dict[str, None] = {}
    for recorded, message in bag.decoded(DIAGNOSTICS.name):
        if first <= recorded.received_ns <= last:
            for status in message.status:
                if status.level != LEVEL_OK:
                    found[f"{status.name}: {status.message}"] = None
    return list(found)
