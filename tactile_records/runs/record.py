"""RunRecord: one run of one arm as arrays, the same whether it came from the offline loop or from a bag.

Each stream keeps its own stamps, since a belief, a truth and a command are not made at the same instants;
`metrics` and `figures` align them by stamp. All is SI; poses are (4, 4) matrices `T_parent_child`::

    record = RunRecord(scene="ramp", task="surface_following")
    record.pose = PoseSeries(stamp_ns, T_base_sensor)
    ...
    record.save("run.npz"); same = RunRecord.load("run.npz")
"""

# ruff: noqa: RUF009 (`_array` declares a column as `field` does)

from __future__ import annotations

import dataclasses
import json
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from tactile_geometry import se3

Array = NDArray[Any]
T = TypeVar("T", bound="Series")


def _array(*shape: int, dtype: Any = np.float64) -> Any:
    """A field that starts as an empty array of the given row shape."""
    return field(
        default_factory=lambda: np.zeros((0, *shape), dtype), metadata={"row": shape, "dtype": dtype}
    )


@dataclass
class Series:
    """Base of all streams: arrays with one row a stamp, checked for length and row shape."""

    stamp_ns: Array = _array(dtype=np.int64)

    def __post_init__(self) -> None:
        rows = len(self.stamp_ns)
        for item in dataclasses.fields(self):
            value = np.asarray(getattr(self, item.name), dtype=item.metadata["dtype"])
            wanted = (rows, *item.metadata["row"])
            if len(value) == 0 and rows > 0:
                value = _missing(wanted, item.metadata["dtype"])
            if value.shape != wanted and rows > 0:
                raise ValueError(f"{type(self).__name__}.{item.name}: shape {value.shape}, must be {wanted}")
            setattr(self, item.name, value)

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def rows(self: T, selection: Array) -> T:
        """The rows that a boolean mask or an index array picks."""
        return type(self)(**{f.name: getattr(self, f.name)[selection] for f in dataclasses.fields(self)})


def _missing(shape: tuple[int, ...], dtype: Any) -> Array:
    """What an optional column holds where nothing was recorded: NaN, False, 0 or an empty string."""
    return np.full(shape, np.nan) if dtype is np.float64 else np.zeros(shape, dtype)


@dataclass
class PoseSeries(Series):
    """The sensor in the arm's base, as the arm reported it."""

    T_base_sensor: Array = _array(4, 4)

    def at(self, stamp_ns: Array) -> Array:
        """The poses (N, 4, 4) at stamps within the series, interpolated on SE(3)."""
        after = np.clip(np.searchsorted(self.stamp_ns, stamp_ns), 1, len(self) - 1)
        first, second = self.stamp_ns[after - 1], self.stamp_ns[after]
        part = (stamp_ns - first) / np.maximum(second - first, 1)
        pairs = zip(self.T_base_sensor[after - 1], self.T_base_sensor[after], part, strict=True)
        return np.array([se3.interpolate(a, b, float(u)) for a, b, u in pairs]).reshape(-1, 4, 4)


@dataclass
class GaussianSeries(Series):
    """Gaussians over X_sf with left covariance (rho, phi): the estimator's answers, at exposure stamps."""

    mean: Array = _array(4, 4)
    cov: Array = _array(6, 6)


@dataclass
class BeliefSeries(GaussianSeries):
    """The filter's beliefs over X_sf, at exposure stamps; `accepted` is False where the gate refused."""

    nis: Array = _array()
    nis_dof: Array = _array(dtype=np.int64)
    accepted: Array = _array(dtype=np.bool_)


@dataclass
class TruthSeries(Series):
    """The simulator's truth: the equivalent surface contact pose X_fs, its z the depth from geometry."""

    T_fs: Array = _array(4, 4)
    slip_fraction: Array = _array()  # part of the nodes in contact that slide, 0..1
    in_contact: Array = _array(dtype=np.bool_)


@dataclass
class ForceSeries(Series):
    """Forces on the sensor in its frame (N) with their covariance, at exposure stamps."""

    force: Array = _array(3)
    cov: Array = _array(3, 3)
    nis: Array = _array()  # of the estimate that was fused; NaN in estimates


@dataclass
class PresenceSeries(Series):
    """The contact detector's answers, at exposure stamps."""

    score: Array = _array()
    in_contact: Array = _array(dtype=np.bool_)
    novelty: Array = _array()  # of the image against those of the training, foreign above 1


@dataclass
class CommandSeries(Series):
    """Twists [v, omega] in {s} (m/s, rad/s) at their emission stamps, with the terms they are made of."""

    twist: Array = _array(6)  # what was sent: after watchdog and limiter
    unlimited: Array = _array(6)  # before watchdog and limiter
    error: Array = _array(6)  # log(X_ss') (m, rad); NaN where the phase does not servo
    feedforward: Array = _array(6)  # in {s}
    reference: Array = _array(6)  # Euler contact pose that is servoed to (m, rad); NaN where none is
    phase: Array = _array(dtype=np.dtype("U16"))
    goal: Array = _array(dtype=np.int64)  # index of the goal among the arm's, from 0
    exposure_ns: Array = _array(dtype=np.int64)  # stamp of the belief used; 0 for none


@dataclass
class ArmSeries(Series):
    """What the arm made of the commands: the twist after its own limits, in {s}."""

    twist: Array = _array(6)


@dataclass
class StageSeries(Series):
    """One stage by exposure stamp: seconds from the exposure to its output, frames dropped by then."""

    seconds: Array = _array()
    dropped: Array = _array(dtype=np.int64)  # and counted, since the first row


@dataclass
class BodySeries(Series):
    """A body that a motion model moves, in the world, as the simulation knows it."""

    T_world_body: Array = _array(4, 4)


class Event(NamedTuple):
    """Something that was told beside the numbers: a phase, a refusal, a change of a parameter, a warning."""

    stamp_ns: int
    kind: str
    text: str


@dataclass
class SurfaceMesh:
    """The true surface in the arm's base frame, for pictures: vertices (V, 3) m, triangles (F, 3) indices."""

    vertices: Array = field(default_factory=lambda: np.zeros((0, 3)))
    faces: Array = field(default_factory=lambda: np.zeros((0, 3), np.int64))


@dataclass
class LooseBody:
    """What the scene says of the body that the arm touches and a motion model moves; nothing without one.

    Attributes
    ----------
    outline : ndarray (N, 3)
        Its closed contour, in its own frame, m: the cut at the height at which the arm's sensor starts.
    T_world_start : ndarray (4, 4)
        Where it is at the start.
    """

    outline: Array = field(default_factory=lambda: np.zeros((0, 3)))
    T_world_start: Array = field(default_factory=lambda: np.eye(4))


@dataclass
class RunRecord:
    """One run of one arm.

    Attributes
    ----------
    task : the arm's task, by its name among the tasks
    task_file : the task file that gave it to the arm
    role : what the arm does in it
    work : the phase of the task that numbers about quality are of
    source : "offline" or "ros"
    tip_radius : radius of the sensor's tip, m
    goals : names of the arm's goals; `command.goal` indexes it
    targets : ndarray (G, 3)
        Position in the base that each goal is to reach, m; NaN for one without such a thing.
    directions : ndarray (G, 3)
        Direction in the base in which each goal is to end, of any length; NaN for one without.
    T_world_base : ndarray (4, 4) where the arm stands
    T_controlled_sensor : ndarray (4, 4)
        Where the sensor is in truth in the frame that is controlled, as a simulation knows.
    force_estimate, force : ForceSeries
        What the network tells of the force, and what the filter believes; empty where it does not tell.
    body : BodySeries
        The body that the arm touches and a motion model moves; empty where nobody knows its pose.
    latency : stage name -> StageSeries, cumulative from the exposure, in the order of the stages
    result : succeeded (bool) and reason (str) of the task, wall_s, and what else is worth a line in a report
    settings : node -> dotted name -> value that it was given, of the nodes that the arm had to do with
    origin : command line, versions, machine and time of the run, as `tactile_base.origin` has them
    events : what was told beside the numbers, by time
    """

    scene: str = ""
    task: str = ""
    task_file: str = ""
    arm: str = "arm"
    role: str = ""
    work: str = "follow"
    source: str = "offline"
    seed: int = 0
    tip_radius: float = 0.020
    goals: list[str] = field(default_factory=list)
    targets: Array = field(default_factory=lambda: np.zeros((0, 3)))
    directions: Array = field(default_factory=lambda: np.zeros((0, 3)))
    T_world_base: Array = field(default_factory=lambda: np.eye(4))
    T_controlled_sensor: Array = field(default_factory=lambda: np.eye(4))
    pose: PoseSeries = field(default_factory=PoseSeries)
    truth: TruthSeries = field(default_factory=TruthSeries)
    estimate: GaussianSeries = field(default_factory=GaussianSeries)
    belief: BeliefSeries = field(default_factory=BeliefSeries)
    presence: PresenceSeries = field(default_factory=PresenceSeries)
    force_estimate: ForceSeries = field(default_factory=ForceSeries)
    force: ForceSeries = field(default_factory=ForceSeries)
    command: CommandSeries = field(default_factory=CommandSeries)
    arm_twist: ArmSeries = field(default_factory=ArmSeries)
    latency: dict[str, StageSeries] = field(default_factory=dict)
    body: BodySeries = field(default_factory=BodySeries)
    surface: SurfaceMesh = field(default_factory=SurfaceMesh)
    loose: LooseBody = field(default_factory=LooseBody)
    result: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    origin: dict[str, str] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)

    def phase_at(self, stamp_ns: Array) -> Array:
        """The phase in force at each stamp: that of the latest command emitted at or before it, else ''."""
        return self._held(self.command.phase, stamp_ns, "")

    @property
    def lost(self) -> dict[str, int]:
        """Stage name -> number of frames lost (dropped and counted) there."""
        return {stage: int(series.dropped[-1]) for stage, series in self.latency.items() if len(series)}

    def working(self, stamp_ns: Array) -> Array:
        """Whether the task was at its own work at each stamp."""
        return np.asarray(self.phase_at(stamp_ns) == self.work)

    def goal_at(self, stamp_ns: Array) -> Array:
        """The index of the goal at each stamp, -1 before the first command."""
        return self._held(self.command.goal, stamp_ns, -1)

    def reference_at(self, stamp_ns: Array) -> Array:
        """The reference contact pose (N, 6) in force at each stamp: the first one that followed, before it.

        NaN where no command of the record has one, as when the task ended before its first belief.
        """
        known = np.flatnonzero(np.isfinite(self.command.reference).all(axis=1))
        if not len(known):
            return np.full((len(stamp_ns), 6), np.nan)
        index = np.searchsorted(self.command.stamp_ns[known], np.asarray(stamp_ns), side="right") - 1
        return np.asarray(self.command.reference[known[np.maximum(index, 0)]])

    def save(self, path: str | Path) -> None:
        """Write all of it into one compressed .npz file."""
        arrays: dict[str, Array] = {}
        plain: dict[str, Any] = {}
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            if isinstance(value, Series | SurfaceMesh | LooseBody):
                arrays |= columns(item.name, value)
            elif item.name == "latency":
                for stage, series in value.items():
                    arrays |= columns(f"latency/{stage}", series)
            elif isinstance(value, np.ndarray):
                arrays[item.name] = value
            else:
                plain[item.name] = value
        arrays["plain"] = np.array(json.dumps(plain | {"stages": list(self.latency)}))
        np.savez_compressed(path, **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: str | Path) -> RunRecord:
        """Read what `save` wrote; `ValueError` for a file that is damaged or anything else."""
        try:
            with np.load(path) as file:
                arrays = dict(file)
            plain = json.loads(str(arrays["plain"]))
            stages, lost = plain.pop("stages"), plain.pop("lost", {})
        except (BadZipFile, EOFError, KeyError, ValueError, zlib.error) as error:
            raise ValueError(f"{path}: no record of a run, or damaged: {error}") from error
        record = cls(**plain)
        record.events = [Event(*event) for event in record.events]
        for item in dataclasses.fields(cls):
            value = getattr(record, item.name)
            if isinstance(value, Series | SurfaceMesh | LooseBody):
                setattr(record, item.name, from_columns(type(value), item.name, arrays))
            elif isinstance(value, np.ndarray):
                setattr(record, item.name, arrays.get(item.name, value))  # older files have fewer
        record.latency = {s: from_columns(StageSeries, f"latency/{s}", arrays) for s in stages}
        for stage, count in lost.items():  # older files tell no more of it
            record.latency[stage].dropped[-1:] = count
        return record

    def _held(self, values: Array, stamp_ns: Array, before: Any) -> Array:
        index = np.searchsorted(self.command.stamp_ns, np.asarray(stamp_ns), side="right") - 1
        if len(values) == 0:
            return np.full(index.shape, before)
        return np.where(index >= 0, values[np.maximum(index, 0)], before)


def columns(prefix: str, value: Any) -> dict[str, Array]:
    """The arrays of a data class by name, for one .npz file with others."""
    return {f"{prefix}/{f.name}": getattr(value, f.name) for f in dataclasses.fields(value)}


def from_columns(kind: Any, prefix: str, arrays: dict[str, Array]) -> Any:
    """The data class that `columns` took apart; what older files lack is as by default."""
    names = {f.name: f"{prefix}/{f.name}" for f in dataclasses.fields(kind)}
    return kind(**{name: arrays[key] for name, key in names.items() if key in arrays})
