"""Turns a recorded bag into a `RunRecord` of each arm, its streams as arrays; reads those kept, too."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tactile_base.input_file import parse_json
from tactile_base.stamps import ns_from_parts
from tactile_base.topics import FORCE_BELIEF, FORCE_ESTIMATE, TF, body_frame
from tactile_control.tasks import TASKS
from tactile_geometry import se3
from tactile_geometry.gaussian import left_from_ros
from tactile_records.bags.contents import noted
from tactile_records.bags.reader import Bag, read_bag
from tactile_records.runs.ending import ending
from tactile_records.runs.events import events_of
from tactile_records.runs.record import BodySeries, RunRecord, Series, StageSeries
from tactile_records.runs.settings_given import given
from tactile_records.runs.surfaces import loose_body, loose_outline, surface_mesh
from tactile_scene.scene_file import SceneError, load_scene

Array = NDArray[Any]
R = TypeVar("R")
S = TypeVar("S", bound=Series)

STAGES = ("camera", "estimator", "filter", "controller", "arm")
GATED, PREDICTED_ONLY, INVALID = 4, 2, 32  # flags of tactile_msgs/ContactState


def read_arms(folder: Path) -> dict[str, RunRecord]:
    """The runs of all arms in a bag, by name.

    `result` of each also holds "bag_complete" and, for a bag that ends early or is damaged, "bag_problem".
    `BagError` if there is no bag or nothing in it can be read; `ValueError` if no arm of it has a controller.
    """
    bag = read_bag(folder)
    arms = arms_of(bag)
    if not arms:
        raise ValueError(f"{folder}: no arm in this bag has a controller: there is no run to report on")
    return {arm: run_from_bag(bag, arm) for arm in arms}


def of_arms(folder: Path, name: str) -> list[Path]:
    """The files of that name in a folder of results: of one arm, or in a folder of each of several."""
    return [folder / name] if (folder / name).exists() else sorted(folder.glob(f"*/{name}"))


def read_runs(source: Path) -> dict[str, RunRecord]:
    """Records by arm, of a bag, a run.npz, or a folder with one of an arm or of each.

    `BagError` or `ValueError` where it is none of them, or damaged.
    """
    files = [source] if source.suffix == ".npz" else of_arms(source, "run.npz")
    return {record.arm: record for record in map(RunRecord.load, files)} if files else read_arms(source)


def run_from_bag(bag: Bag, arm: str) -> RunRecord:
    """The run of one arm, from a bag that was read before."""
    rows = _Rows(bag, arm)
    role = noted(bag.note, "roles").get(arm, {})
    task = role.get("task", "surface_following")
    record = RunRecord(
        scene=bag.note.get("scene", ""),
        task=task,
        task_file=bag.note.get("task", ""),
        arm=arm,
        role=role.get("role", ""),
        work=TASKS.load(task).work if task in TASKS.names() else "",
        source="ros",
        seed=int(bag.note.get("seed", 0)),
        goals=role.get("goals", []),
        tip_radius=role.get("tip_radius", RunRecord.tip_radius),
        targets=_rows_of_three(role.get("targets", [])),
        directions=_rows_of_three(role.get("directions", [])),
        T_world_base=np.array(role.get("T_world_base", np.eye(4).tolist())),
        T_controlled_sensor=np.array(role.get("T_controlled_sensor", np.eye(4).tolist())),
    )
    for stream, (topic, row) in STREAMS.items():
        setattr(record, stream, rows.series(type(getattr(record, stream)), topic, row))
    record.latency = _latency(rows)
    problem = _add_bodies(record, bag)
    record.settings, record.origin = given(noted(bag.note, "parameters"), arm), _origin(bag)
    record.events = events_of(bag, arm)
    record.result = ending(bag, record) | ({"surface_problem": problem} if problem else {})
    return record


def _origin(bag: Bag) -> dict[str, str]:
    """As `tactile_base.origin` had it noted; empty for a recording of other makes."""
    try:
        found = parse_json(bag.note.get("origin", "{}"))
    except ValueError:
        found = None
    if not isinstance(found, dict):
        bag.problems.append("the bag's note 'origin': must hold texts by name; it is left out")
        return {}
    return {str(name): str(text) for name, text in found.items()}


def _rows_of_three(given: list[list[float] | None]) -> Array:
    """Rows (N, 3); NaN for None."""
    return np.array([row or [np.nan] * 3 for row in given], dtype=float).reshape(-1, 3)


@dataclass
class _Rows:
    """Decoded messages of one arm, as rows of a series in the order of their stamps."""

    bag: Bag
    arm: str

    def rows(self, topic: str, row: Callable[[Any], R | None]) -> list[R]:
        """What `row` makes of each message, but None; a message of which it makes nothing is a problem."""
        found, senseless = [], []
        for _, message in self.bag.decoded(f"/{self.arm}/{topic}"):
            try:
                values = row(message)
            except (AttributeError, TypeError, ValueError) as error:
                senseless.append(str(error))
            else:
                found += [] if values is None else [values]
        if senseless:
            text = f"{len(senseless)} messages cannot be used, the first: {senseless[0]}"
            self.bag.problems.append(f"/{self.arm}/{topic}: {text}")
        return found

    def series(self, kind: type[S], topic: str, row: Callable[[Any], dict[str, Any] | None]) -> S:
        """One row a message, by stamp; `row` gives its columns, or None for a message that holds nothing."""
        rows = self.rows(topic, row)
        rows.sort(key=lambda values: values["stamp_ns"])
        names = rows[0] if rows else ()
        return kind(**{name: np.array([values[name] for values in rows]) for name in names})


def _ns(time: Any) -> int:
    return ns_from_parts(time.sec, time.nanosec)


def stamp_of(message: Any) -> int:
    """Stamp of a message's header, ns."""
    return _ns(message.header.stamp)


def pose_matrix(pose: Any) -> Array:
    """T (4, 4) of a geometry_msgs/Pose."""
    return _matrix(pose.position, pose.orientation)


def transform_matrix(transform: Any) -> Array:
    """T (4, 4) of a geometry_msgs/Transform."""
    return _matrix(transform.translation, transform.rotation)


def _matrix(position: Any, orientation: Any) -> Array:
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_quaternion([getattr(orientation, axis) for axis in "xyzw"])
    T[:3, 3] = _finite(np.array([position.x, position.y, position.z]), "its position")
    return T


def _finite(values: Array, name: str) -> Array:
    if not np.isfinite(values).all():
        raise ValueError(f"{name} is not finite")
    return values


def _pose_row(message: Any) -> dict[str, Any]:
    return {"stamp_ns": stamp_of(message), "T_base_sensor": pose_matrix(message.pose)}


def truth_row(message: Any) -> dict[str, Any]:
    """Columns of `TruthSeries`."""
    T_fs = se3.pose_from_euler(np.asarray(message.euler))
    T_fs[2, 3] = message.depth
    row = {"stamp_ns": stamp_of(message), "T_fs": T_fs}
    return row | {name: getattr(message, name) for name in ("slip_fraction", "in_contact")}


def gaussian_row(message: Any) -> dict[str, Any]:
    """Stamp, mean and left covariance of a PoseWithCovarianceStamped."""
    mean = pose_matrix(message.pose.pose)
    cov = left_from_ros(_finite(np.reshape(message.pose.covariance, (6, 6)), "its covariance"), mean[:3, 3])
    return {"stamp_ns": stamp_of(message), "mean": mean, "cov": cov}


def _belief_row(message: Any) -> dict[str, Any] | None:
    if message.flags & INVALID or not np.isfinite(message.xi).all():
        return None
    return {
        "stamp_ns": stamp_of(message),
        "mean": se3.exp(np.asarray(message.xi)),
        "cov": _finite(np.reshape(message.covariance, (6, 6)), "its covariance"),
        "nis": message.nis,
        "nis_dof": message.nis_dof,
        "accepted": not message.flags & (GATED | PREDICTED_ONLY),
    }


def _presence_row(message: Any) -> dict[str, Any]:
    novelty = getattr(message, "novelty", math.nan)  # earlier recordings have none
    row = {"stamp_ns": stamp_of(message), "score": message.score}
    return row | {"in_contact": message.in_contact, "novelty": novelty}


def _force_row(message: Any) -> dict[str, Any]:
    return {
        "stamp_ns": stamp_of(message),
        "force": _finite(np.asarray(message.force), "its force"),
        "cov": _finite(np.reshape(message.covariance, (3, 3)), "its covariance"),
        "nis": message.nis,
    }


def _command_row(message: Any) -> dict[str, Any]:
    same = ("unlimited", "error", "feedforward", "reference", "phase", "goal")
    row = {"stamp_ns": stamp_of(message), "twist": message.limited, "exposure_ns": _ns(message.belief_stamp)}
    return row | {name: getattr(message, name) for name in same}


def _arm_row(message: Any) -> dict[str, Any]:
    return {"stamp_ns": stamp_of(message), "twist": message.twist}


#: Topic of each stream of a record, and what makes a row of one of its messages.
STREAMS: dict[str, tuple[str, Callable[[Any], dict[str, Any] | None]]] = {
    "pose": ("arm/pose", _pose_row),
    "truth": ("sim/truth", truth_row),
    "estimate": ("contact/estimate", gaussian_row),
    "belief": ("contact/state", _belief_row),
    "presence": ("contact/presence", _presence_row),
    "force_estimate": (FORCE_ESTIMATE.name, _force_row),
    "force": (FORCE_BELIEF.name, _force_row),
    "command": ("controller/status", _command_row),
    "arm_twist": ("arm/status", _arm_row),
}


def frames_of(message: Any) -> tuple[str, list[tuple[int, float, int]]]:
    """Stage, and the frames that it tells of: exposure (ns), latency (s), how many it has dropped by then."""
    parts = zip(message.exposed, message.emitted, message.dropped, strict=True)
    return message.stage, [(_ns(e), (_ns(out) - _ns(e)) * 1e-9, int(dropped)) for e, out, dropped in parts]


def _latency(rows: _Rows) -> dict[str, StageSeries]:
    """Latency of each stage, and the frames that it dropped since its first answer here, by stage in order.

    A stage counts from its activation, which may come before the recording: what it dropped until then is not
    of this record.
    """
    by_stage: dict[str, list[tuple[int, float, int]]] = {}
    for stage, frames in rows.rows("latency", frames_of):
        if frames:
            by_stage.setdefault(stage, []).extend(frames)
    series = {}
    for stage in sorted(by_stage, key=lambda name: STAGES.index(name) if name in STAGES else len(STAGES)):
        stamps, seconds_each, counts = zip(*sorted(by_stage[stage]), strict=True)
        dropped = np.maximum.accumulate(counts) - counts[0]
        series[stage] = StageSeries(np.array(stamps), np.array(seconds_each), dropped)
    return series


def _add_bodies(record: RunRecord, bag: Bag) -> str:
    """The bodies that the arm can touch; or none, and why: the scene file may have gone or changed."""
    try:
        scene = load_scene(bag.note.get("scene_file", "scene_file.yaml"))
        record.surface, record.loose = surface_mesh(scene, record.arm), loose_outline(scene, record.arm)
    except (SceneError, KeyError) as error:
        return f"the true surface is not drawn: {error}"
    name = loose_body(scene, record.arm)
    if name:
        record.body = _body_series(bag, body_frame(name))
    return ""


def _body_series(bag: Bag, frame: str) -> BodySeries:
    """The poses in the world of a frame that only the simulation publishes."""
    rows = []
    for _, message in bag.decoded(TF.name):
        for transform in message.transforms:
            if transform.child_frame_id != frame:
                continue
            try:
                T = transform_matrix(transform.transform)
            except ValueError as error:
                bag.problems.append(f"{TF.name}: {frame}: {error}")
            else:
                rows.append((_ns(transform.header.stamp), T))
    rows.sort(key=lambda row: row[0])
    return BodySeries(*map(np.array, zip(*rows, strict=True))) if rows else BodySeries()


def arms_of(bag: Bag) -> list[str]:
    """The arms that had something to do, by name."""
    roles = noted(bag.note, "roles")
    if roles:
        return sorted(roles)
    suffix = "/controller/status"
    return sorted({topic[1 : -len(suffix)] for topic in bag.topics if topic.endswith(suffix)})
