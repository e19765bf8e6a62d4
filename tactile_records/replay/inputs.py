"""What a filter takes, from a bag: for each arm the events in their order, each with the sensor's pose.

An event is what live nodes join by stamp: the contact presence and the estimate of one exposure. Which events
there are, and where the sensor was, does not depend on the filter's settings: it is worked out once and
serves all runs of a sweep.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tactile_base.topics import ESTIMATE, FORCE_ESTIMATE, PRESENCE, TF, TF_STATIC, contact_frame
from tactile_geometry.transform_buffer import MotionLimits
from tactile_records.bags.reader import Bag, read_bag
from tactile_records.replay.settings import recorded_group
from tactile_records.replay.topics import (
    ReplayError,
    Timeline,
    TopicReader,
    assign_epochs,
    split_epochs,
    wanted_topics,
)
from tactile_records.replay.track import ArmInputs, Track
from tactile_records.replay.transforms import Recording, Restart, between, read_transforms, refuse_jumps


@dataclass
class Inputs:
    """A bag, made ready for replay.

    Attributes
    ----------
    arms : list of ArmInputs
        Those that can be replayed.
    remarks : list of str
        What concerns the whole bag, arms that cannot be replayed included.
    span_s : float
        From the first message to the last one.
    """

    bag: Bag
    arms: list[ArmInputs]
    remarks: list[str]
    span_s: float


def read_inputs(folder: Path, base_frame: str = "") -> Inputs:
    """Read a bag for replay.

    Parameters
    ----------
    base_frame : str
        A frame in which the surface stands still; empty for each arm's own base.

    Raises
    ------
    BagError
        There is no bag, or nothing in it can be read.
    ReplayError
        No arm of the bag can be replayed.
    """
    bag = read_bag(folder, wanted_topics)
    return inputs_of(bag, base_frame)


def inputs_of(bag: Bag, base_frame: str = "") -> Inputs:
    """Inputs of a bag that was read before; see `read_inputs`."""
    reader = TopicReader(bag)
    remarks: list[str] = []
    names = sorted(arm for topic, count in bag.counts.items() if (arm := ESTIMATE.arm_of(topic)) and count)
    if not names:
        topics = ", ".join(sorted(bag.topics)) or "none"
        raise ReplayError(
            f"{bag.folder}: no messages on <arm>/{ESTIMATE.name}; topics with messages: {topics}"
        )
    tracks = {}
    for name in names:
        try:
            tracks[name] = Track(reader, name, base_frame)
        except ReplayError as error:
            remarks.append(str(error))
    messages = reader.with_places(TF.name, TF_STATIC.name)
    fields = bag.typestore(messages[0][1].type).fielddefs if messages else {}
    recording = read_transforms(fields, messages, ignore=[contact_frame(name) for name in names])
    for track in tracks.values():
        track.find_the_sensor(recording)
    remarks += _remarks_of(bag, recording)
    hint = _lacking(recording)
    arms = []
    for track in tracks.values():
        own = between(recording, track.arm.base_frame, track.arm.sensor_frame)
        found = _assign_epochs(
            own, track, recorded_group(bag.note, track.arm.name, "transforms.", MotionLimits)
        )
        remarks += [remark for remark in found if remark not in remarks]
        try:
            arms.append(track.finished(own, hint))
        except ReplayError as error:
            remarks.append(str(error))
    if not bag.complete:
        remarks.insert(0, f"bag not complete: {bag.problem}")
    if not arms:
        raise ReplayError(f"{bag.folder}: no arm can be replayed: " + "; ".join(remarks))
    times = [message.received_ns for message in bag.messages]
    return Inputs(bag, arms, remarks, (max(times) - min(times)) * 1e-9 if times else 0.0)


def _assign_epochs(recording: Recording, track: Track, limits: MotionLimits) -> list[str]:
    """Give each message and each transform of an arm its epoch, without those that jumped; remarks on it."""
    sources: dict[str, Timeline] = {f"/tf of {child}": link for child, link in recording.moving.items()}
    parts = (track.estimate, ESTIMATE), (track.presence, PRESENCE), (track.force, FORCE_ESTIMATE)
    for topic, kind in parts:
        if len(topic):
            sources[kind.of(track.arm.name).name] = topic
    remarks = [
        f"the clock went back by {jump.seconds:.3f} s after {jump.before_ns} ns, first in {jump.source}: the "
        "filter starts anew there"
        for jump in assign_epochs(sources)
    ]
    restarts: list[Restart] = []
    for child, link in recording.moving.items():
        refused, found = refuse_jumps(link, child, limits)
        restarts += found
        remarks += [f"/tf: {refused} transforms of '{child}' jumped and are passed over"] if refused else []
    remarks += [f"/tf: {restart.reason}: the filter starts anew there" for restart in restarts]
    split_epochs(sources.values(), [(restart.epoch, restart.before_ns) for restart in restarts])
    return remarks


def _lacking(recording: Recording) -> str:
    """What the bag lacks, where no pose at all can be looked up."""
    kinds = zip((TF.name, TF_STATIC.name), (recording.moving, recording.static), strict=True)
    lacking = [name for name, links in kinds if not links]
    return f"; the bag has no messages on {' and '.join(lacking)}" if lacking else ""


def _remarks_of(bag: Bag, recording: Recording) -> list[str]:
    remarks = [f"no messages on {name}" for name in (TF.name, TF_STATIC.name) if not bag.counts.get(name)]
    if recording.unreadable:
        count, reason = len(recording.unreadable), recording.unreadable[0]
        remarks.append(f"/tf: {count} messages cannot be decoded, the first: {reason}")
    remarks += [
        f"/tf: {count} transforms of '{child}' are none and are passed over"
        for child, count in recording.refused.items()
    ]
    remarks += [
        f"/tf_static: '{child}' changes during the recording; the last is taken for all of it"
        for child in recording.changed
    ]
    remarks += [
        f"/tf: {count} transforms of '{child}' are stamped ahead of the clock and passed over"
        for child, count in recording.early.items()
        if count
    ]
    return remarks
