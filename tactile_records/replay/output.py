"""Writes the bag of a replayed run: beliefs and states, and on request what they were made from."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from tactile_base.topics import BELIEF, FORCE_BELIEF, RELIABLE, SMOOTHED, STATE, TF_STATIC, Topic
from tactile_filter.belief import Belief
from tactile_records.bags.contents import Recorded, noted
from tactile_records.bags.message_columns import rows_of
from tactile_records.bags.reader import Bag
from tactile_records.bags.writer import BagWriter
from tactile_records.replay.run import ArmRun, force_rows, pose_rows
from tactile_wire.message_definitions import message_definition

Array = NDArray[Any]

OUTPUTS = (BELIEF, STATE, SMOOTHED, FORCE_BELIEF)


def write_bag(folder: Path, bag: Bag, runs: Sequence[ArmRun], copies: Sequence[Recorded] = ()) -> None:
    """Write the new bag.

    A message has the time of reception of the last input that it was made from. The note of the recording is
    kept, with the settings of the run in the place of those that were live, and "replay" says what of.

    Parameters
    ----------
    copies : sequence of Recorded
        Messages of the recording that go into the new bag as they are.

    Raises
    ------
    BagError
        The folder exists.
    """
    messages: list[Recorded] = []
    topics: dict[str, Topic] = {}
    for message in copies:
        if not any(output.arm_of(message.topic) for output in OUTPUTS):
            qos = TF_STATIC.qos if message.topic == TF_STATIC.name else RELIABLE
            topics.setdefault(message.topic, Topic(message.topic, message.type, qos))
            messages.append(message)
    for run in runs:
        for message in _messages(run):
            topics.setdefault(message.topic, Topic(message.topic, message.type))
            messages.append(message)
    messages.sort(key=lambda message: message.received_ns)
    definitions = {type_name: text for type_name, text in bag.definitions.items() if type_name != STATE.type}
    definitions |= {name: message_definition(name) for name in (STATE.type, BELIEF.type, FORCE_BELIEF.type)}
    ordered = [topics[name] for name in sorted(topics)]
    with BagWriter(folder, ordered, definitions, _note(bag, runs)) as writer:
        for message in messages:
            writer.write(message.topic, message.data, message.received_ns, message.published_ns)
        for gap in bag.gaps:
            if gap.topic in topics:
                writer.add_gap(gap)


def _messages(run: ArmRun) -> list[Recorded]:
    """What a run publishes."""
    received = [measurement.received_ns for measurement in run.measurements]
    states = _recorded(run, STATE, run.states, received)
    rows = force_rows([force for force, _ in run.forces], run.inputs.sensor_frame)
    forces = _recorded(run, FORCE_BELIEF, rows, [received_ns for _, received_ns in run.forces])
    return states + _poses(run, BELIEF, run.beliefs) + _poses(run, SMOOTHED, run.smoothed) + forces


def _poses(run: ArmRun, topic: Topic, beliefs: Sequence[Belief]) -> list[Recorded]:
    """Beliefs, one for each measurement, as poses; those that are not valid are none."""
    valid = [
        (belief, m.received_ns) for belief, m in zip(beliefs, run.measurements, strict=False) if belief.valid
    ]
    rows = pose_rows([(b.stamp_ns, b.mean, b.cov) for b, _ in valid], run.inputs.sensor_frame)
    return _recorded(run, topic, rows, [received_ns for _, received_ns in valid])


def _recorded(run: ArmRun, topic: Topic, rows: Array, received: list[int]) -> list[Recorded]:
    name = topic.of(run.inputs.name).name
    return [
        Recorded(name, topic.type, data, received_ns, received_ns)
        for data, received_ns in zip(rows_of(rows), received, strict=True)
    ]


def _note(bag: Bag, runs: Sequence[ArmRun]) -> dict[str, str]:
    parameters = noted(bag.note, "parameters")
    settings = {f"/{run.inputs.name}/filter": dataclasses.asdict(run.settings) for run in runs}
    return bag.note | {
        "parameters": json.dumps(parameters | settings),
        "replay": json.dumps({"bag": str(bag.folder.resolve()), "complete": bag.complete}),
    }
