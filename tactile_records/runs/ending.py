"""How a recorded run ended: which goals were reached, why one was not, what nodes complained about then."""

from __future__ import annotations

import operator
from collections.abc import Iterator
from typing import Any, NamedTuple

from tactile_base.node_topics import LAUNCH_LOG
from tactile_base.process_limits import OVERLOADED
from tactile_base.stamps import SECOND_NS
from tactile_base.topics import CONTROLLER_STATUS, DIAGNOSTICS, ROSOUT
from tactile_records.bags.contents import Bag
from tactile_records.messages import IDLE
from tactile_records.runs.record import RunRecord

DONE = "done"  # phase
CANCELLED = "cancelled"  # the reason of a goal that was
LEVEL_OK = 0  # of diagnostic_msgs/DiagnosticStatus
BEFORE, AFTER = 3.0, 0.5  # s about the end of a goal in which a complaint may say why
SILENT = 1.0  # s without a status after which a controller counts as gone: it has one in every step


class _End(NamedTuple):
    """Why a goal was not reached, and since when that was said (ns, as bags are stamped)."""

    why: str
    since_ns: int


def ending(bag: Bag, record: RunRecord) -> dict[str, Any]:
    """The result of a run (`RunRecord.result`), as far as the bag knows.

    The reason is what the controller said, or the launch, or that neither said anything. `complaints` are
    those of all nodes about the end of the goal that was not reached, each once, in their order, then that
    the machine was overloaded, by the launch.
    """
    result: dict[str, Any] = {"bag_complete": bag.complete, "complaints": [], "reason": ""}
    if not bag.complete:
        result["bag_problem"] = bag.problem
    if bag.messages:
        result["wall_s"] = (bag.messages[-1].received_ns - bag.messages[0].received_ns) * 1e-9
    phase, goal = record.command.phase, record.command.goal
    reached = [DONE in phase[goal == index] for index in range(len(record.goals))]
    result["succeeded"] = bool(record.goals) and all(reached)
    if not all(reached):
        missed = reached.index(False)
        end = _end(bag, record.arm, missed)
        result["reason"] = f"goal {record.goals[missed]} was not reached: {end.why}"
        overloads = [text for text in _launcher_said(bag) if text.startswith(OVERLOADED)]
        result["complaints"] = _complaints(bag, end.since_ns) + overloads[-1:]
    return result


def _end(bag: Bag, arm: str, missed: int) -> _End:
    last, heard_ns = None, 0
    statuses = _fields(bag, CONTROLLER_STATUS.of(arm).name, "goal", "phase", "reason")
    for heard_ns, goal, phase, reason in statuses:
        if goal == missed and phase != IDLE:
            since_ns = last[2] if last is not None and reason and reason == last[1] else heard_ns
            last = phase, reason, since_ns
    launcher = [text for text in _launcher_said(bag) if not text.startswith(OVERLOADED)]
    if last is None:
        return _End(": ".join(["it was not begun", *launcher[-1:]]), heard_ns)
    phase, reason, since_ns = last
    if launcher and reason in ("", CANCELLED):
        return _End(launcher[-1], since_ns)
    silence = (bag.messages[-1].received_ns - heard_ns) / SECOND_NS
    if not reason and silence > SILENT:
        return _End(f"nothing was heard of its controller for the last {silence:.1f} s", since_ns)
    return _End(reason or f"the recording ends in its phase '{phase}'", since_ns)


def _launcher_said(bag: Bag) -> list[str]:
    """What nodes did not know of the end: one of them died, somebody pressed Ctrl-C, too little time."""
    said = [text for _, name, text in _fields(bag, ROSOUT.name, "name", "msg") if name == LAUNCH_LOG]
    return [str(text).splitlines()[0] for text in said if text]


def _complaints(bag: Bag, end_ns: int) -> list[str]:
    """What nodes complained about at that time, once each."""
    first, last = end_ns - BEFORE * SECOND_NS, end_ns + AFTER * SECOND_NS
    found: dict[str, None] = {}
    for received_ns, statuses in _fields(bag, DIAGNOSTICS.name, "status"):
        if not first <= received_ns <= last or not isinstance(statuses, list):
            continue
        for level, name, text in filter(None, map(_status, statuses)):
            if level != LEVEL_OK:
                found[f"{name}: {text}"] = None
    return list(found)


def _status(status: Any) -> tuple[Any, ...] | None:
    try:
        return (status.level, status.name, status.message)
    except AttributeError:
        return None


def _fields(bag: Bag, topic: str, *names: str) -> Iterator[tuple[Any, ...]]:
    """When each message of a topic was received (ns), and its fields; nothing of one that has others."""
    take = operator.attrgetter(*names)
    for recorded, message in bag.decoded(topic):
        try:
            values = take(message)
        except AttributeError:  # told where the numbers of this topic are read, if it is one of those
            continue
        yield (recorded.received_ns, *(values if len(names) > 1 else (values,)))
