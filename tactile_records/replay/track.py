"""One arm of a recording: its topics on their way to what a filter takes."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_base.topics import ARM_POSE, ESTIMATE, FORCE_ESTIMATE, PRESENCE, STATE, TRUTH
from tactile_filter.contact_bounds import TACTIP, ContactBounds
from tactile_filter.filter_settings import FilterSettings
from tactile_filter.force import ForceGaussian, ForceSettings
from tactile_geometry import se3
from tactile_geometry.gaussian import UNUSABLE, PoseGaussian
from tactile_geometry.transform_buffer import TransformUnavailable
from tactile_records.replay.settings import (
    Change,
    commanded_resets,
    recorded_changes,
    recorded_group,
    recorded_settings,
)
from tactile_records.replay.topics import ARM_POSE_PARTS, NO_STAMP, POSE, Messages, ReplayError, TopicReader
from tactile_records.replay.transforms import Recording, connected, follow_pose, poses_at
from tactile_records.runs.record import TruthSeries
from tactile_wire.pose_numbers import gaussians_from_numbers

Array = NDArray[Any]

BASE = "base"


@dataclass(frozen=True)
class Measurement:
    """One event of an arm.

    Attributes
    ----------
    received_ns : int
        When the last of its parts was recorded.
    estimate : PoseGaussian or None
        Of X_sf; None where nothing touches the sensor.
    T_base_sensor : (4, 4) or None
        Where the sensor was; not looked up where nothing touches it.
    force : ForceGaussian or None
        What the network told of the force.
    """

    stamp_ns: int
    received_ns: int
    epoch: int
    estimate: PoseGaussian | None
    T_base_sensor: Array | None
    force: ForceGaussian | None = None


class _Event(NamedTuple):
    """A measurement for which the sensor's pose is still to be found."""

    epoch: int
    stamp_ns: int
    received_ns: int
    estimate: PoseGaussian | None


@dataclass
class LiveStates:
    """What the live filter published: stamps (N,), and the messages as structured array (N,)."""

    stamps_ns: Array
    values: Array


@dataclass
class ArmInputs:
    """What one arm's filter takes.

    Attributes
    ----------
    measurements : list of Measurement
        In the order of (epoch, stamp).
    live : LiveStates or None
        What the live filter made of them, where the bag holds it.
    changes : list of Change
        Of the live filter's settings while it ran.
    resets : frozenset of int
        Stamps at which the live filter had been asked to start anew.
    remarks : list of str
        What is missing, was refused, or is odd.
    bounds, force_settings : ContactBounds, ForceSettings
        Of the live filter.
    """

    name: str
    base_frame: str
    sensor_frame: str
    measurements: list[Measurement] = field(default_factory=list)
    truth: TruthSeries = field(default_factory=TruthSeries)
    live: LiveStates | None = None
    changes: list[Change] = field(default_factory=list)
    resets: frozenset[int] = frozenset()
    remarks: list[str] = field(default_factory=list)
    bounds: ContactBounds = TACTIP
    force_settings: ForceSettings = field(default_factory=ForceSettings)


class Track:
    """One arm's topics on their way to measurements."""

    def __init__(self, reader: TopicReader, name: str, base_frame: str) -> None:
        self.arm = ArmInputs(name, base_frame, "")
        self.reader = reader
        self.arm.bounds = recorded_group(reader.bag.note, name, "bounds.", ContactBounds)
        self.arm.force_settings = recorded_group(reader.bag.note, name, "force.", ForceSettings)
        remarks = self.arm.remarks
        self.estimate = reader.topic(ESTIMATE, name, remarks)
        self.presence = reader.topic(PRESENCE, name, remarks)
        self.force = reader.topic(FORCE_ESTIMATE, name, remarks)
        self.state = reader.topic(STATE, name, remarks)
        self.truth = reader.topic(TRUTH, name, remarks)
        self.rows, self.gaussians = self._take_estimates()
        for group in self.presence.columns:
            if group.layout.texts["header.frame_id"] != self.arm.sensor_frame:
                self.presence.stamps_ns[group.indices] = NO_STAMP
                remarks.append(f"{len(group.indices)} presences are not in frame '{self.arm.sensor_frame}'")
        if not len(self.presence):
            remarks.append(f"no {PRESENCE.name}: every estimate counts as one in contact")

    def find_the_sensor(self, recording: Recording) -> None:
        """Where transforms do not connect the sensor with its base, take the arm's report of its pose."""
        arm = self.arm
        if connected(recording, arm.base_frame, arm.sensor_frame):
            return
        topic = self.reader.topic(ARM_POSE, arm.name, arm.remarks)
        frames = {group.layout.texts["header.frame_id"] for group in topic.columns}
        if frames != {arm.base_frame}:
            return
        numbers = np.zeros((len(topic), 7))
        for group in topic.columns:
            numbers[group.indices] = group.stack(ARM_POSE_PARTS)
        sensor, base = arm.sensor_frame, arm.base_frame
        follow_pose(recording, topic.stamps_ns, topic.order, base, sensor, numbers)
        arm.remarks.append(
            f"no transforms between '{base}' and '{sensor}': the sensor's poses are those of {ARM_POSE.name}"
        )

    def finished(self, recording: Recording, hint: str) -> ArmInputs:
        """Join, look the sensor's poses up, and add what there is to compare with.

        Where no pose is found at all, `hint` says what the bag lacks.
        """
        arm = self.arm
        joined = self._joined()
        arm.measurements = self._with_poses(joined, recording, hint)
        arm.truth = _truth(self.truth)
        arm.live = _live(self.state)
        arm.changes = recorded_changes(self.reader.bag, arm.name)
        if arm.live is not None:
            values = recorded_settings(self.reader.bag.note, arm.name)[0]
            age = FilterSettings.from_mapping(values).max_prediction_age
            live = arm.live.values
            arm.resets = commanded_resets(arm.live.stamps_ns, live["flags"], live["nis"], age)
        return arm

    def _take_estimates(self) -> tuple[Array, list[PoseGaussian]]:
        """Rows of the estimates in the sensor's frame, and the Gaussians; live filters pass others over."""
        topic, remarks = self.estimate, self.arm.remarks
        if not topic.columns:
            raise ReplayError(f"{self.arm.name} cannot be replayed: {'; '.join(remarks)}")
        sizes: Counter[str] = Counter()
        for group in topic.columns:
            sizes[group.layout.texts["header.frame_id"]] += len(group.indices)
        sensor = max(sizes, key=lambda frame: sizes[frame])
        self.arm.sensor_frame = sensor
        self.arm.base_frame = self.arm.base_frame or "/".join([*sensor.split("/")[:-1], BASE])
        groups = [g for g in topic.columns if g.layout.texts["header.frame_id"] == sensor]
        rows = np.concatenate([group.indices for group in groups])
        poses = np.concatenate([group.stack(POSE) for group in groups])
        covs = np.concatenate([group.values["pose.covariance"] for group in groups]).reshape(-1, 36)
        gaussians = gaussians_from_numbers(np.concatenate([poses, covs], axis=1))
        unusable = sum(gaussian is UNUSABLE for gaussian in gaussians)
        if unusable:
            remarks.append(f"{unusable} estimates are not finite or no Gaussians: there the filter predicts")
        if len(rows) < sum(sizes.values()):
            others = sum(sizes.values()) - len(rows)
            remarks.append(f"{others} estimates are not in frame '{sensor}' and are passed over")
        return rows, gaussians

    def _joined(self) -> list[_Event]:
        """The events by epoch and stamp: what live nodes join, whatever the order of its parts was."""
        presence = _first_of_each_stamp(self.presence, np.arange(len(self.presence)))
        estimate = _first_of_each_stamp(self.estimate, self.rows)
        stamps = np.concatenate([self.presence.stamps_ns, self.estimate.stamps_ns[self.rows]])
        repeated = int((stamps >= 0).sum()) - len(presence) - len(estimate)
        if repeated:
            self.arm.remarks.append(
                f"{repeated} messages have the stamp of one before them and are passed over"
            )
        in_contact, gaussians = (
            _in_contact(self.presence),
            dict(zip(self.rows.tolist(), self.gaussians, strict=True)),
        )
        events, alone = [], 0
        for key in sorted(presence.keys() | estimate.keys()):
            touching = bool(in_contact[presence[key]]) if key in presence else True
            if touching and key not in estimate:
                alone += 1
                continue
            received = [
                int(topic.received_ns[rows[key]])
                for topic, rows in ((self.presence, presence), (self.estimate, estimate))
                if key in rows
            ]
            events.append(_Event(*key, max(received), gaussians[estimate[key]] if touching else None))
        if alone:
            self.arm.remarks.append(f"{alone} presences in contact have no estimate and are passed over")
        return events

    def _with_poses(self, events: list[_Event], recording: Recording, hint: str) -> list[Measurement]:
        arm = self.arm
        found: dict[tuple[int, int], Any] = {}
        for epoch in sorted({event.epoch for event in events}):
            touching = [e.stamp_ns for e in events if e.epoch == epoch and e.estimate is not None]
            stamps = np.array(touching, np.int64)
            poses = poses_at(recording, arm.base_frame, arm.sensor_frame, stamps, epoch)
            found |= {(epoch, stamp_ns): pose for stamp_ns, pose in zip(touching, poses, strict=True)}
        missing = [pose for pose in found.values() if isinstance(pose, TransformUnavailable)]
        if found and len(missing) == len(found):
            raise ReplayError(f"{arm.name} cannot be replayed: {missing[0]}{hint}")
        if missing:
            arm.remarks.append(
                f"{len(missing)} estimates have no pose of the sensor, the first: {missing[0]}"
            )
        measurements, forces = [], _forces(self.force)
        for event in events:
            pose = found.get((event.epoch, event.stamp_ns))
            if not isinstance(pose, TransformUnavailable):
                what = event.estimate, pose, forces.get((event.epoch, event.stamp_ns))
                measurements.append(Measurement(event.stamp_ns, event.received_ns, event.epoch, *what))
        return measurements


def _first_of_each_stamp(topic: Messages, rows: Array) -> dict[tuple[int, int], int]:
    """(epoch, stamp) -> row, of these rows; of equal stamps the first one holds, as in the live nodes."""
    found: dict[tuple[int, int], int] = {}
    rows = rows[np.argsort(topic.order[rows], kind="stable")]
    rows = rows[topic.stamps_ns[rows] >= 0]  # others are NO_STAMP
    for key, row in zip(
        zip(topic.epochs[rows].tolist(), topic.stamps_ns[rows].tolist(), strict=True),
        rows.tolist(),
        strict=True,
    ):
        found.setdefault(key, row)
    return found


def _forces(topic: Messages) -> dict[tuple[int, int], ForceGaussian]:
    """What the network told of the force, by (epoch, stamp); of equal stamps the first."""
    found: dict[int, ForceGaussian] = {}
    for group in topic.columns:
        values = zip(group.values["force"], group.values["covariance"].reshape(-1, 3, 3), strict=True)
        found |= {int(row): ForceGaussian(*pair) for row, pair in zip(group.indices, values, strict=True)}
    return {key: found[row] for key, row in _first_of_each_stamp(topic, np.arange(len(topic))).items()}


def _in_contact(topic: Messages) -> list[bool]:
    values = np.zeros(len(topic), bool)
    for group in topic.columns:
        values[group.indices] = group.values["in_contact"]
    return [bool(value) for value in values]


def _truth(topic: Messages) -> TruthSeries:
    """The simulator's truth by stamp, its depth from geometry."""
    if not len(topic):
        return TruthSeries()
    stamp_ns = np.concatenate([group.stamps_ns() for group in topic.columns])
    euler, depth, slip, touching = (
        np.concatenate([group.values[name] for group in topic.columns])
        for name in ("euler", "depth", "slip_fraction", "in_contact")
    )
    T_fs = np.full((len(euler), 4, 4), np.nan)  # where the simulator gives none
    known = np.isfinite(euler).all(axis=1)
    T_fs[known] = se3.pose_from_euler(euler[known])
    T_fs[:, 2, 3] = depth
    order = np.argsort(stamp_ns, kind="stable")
    return TruthSeries(stamp_ns[order], T_fs[order], slip[order], touching[order])


def _live(topic: Messages) -> LiveStates | None:
    """What the live filter published; None where the bag does not hold it."""
    if len(topic.columns) != 1:  # none, or frames that change within it: nothing to compare with
        return None
    return LiveStates(topic.columns[0].stamps_ns(), topic.columns[0].values)
