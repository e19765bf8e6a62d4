"""Pushing: how near the push came to its target, and the paper's picture of it, seen from above.

The final target error is the paper's: the perpendicular distance, in the plane of the floor, from the target
to the line through the contact along the contact normal, at the end of the push. Here it has a sign: it is
positive where the target lies to the left of that line, seen from above and along the push.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from tactile_geometry import se3
from tactile_records.runs import metrics
from tactile_records.runs.euler_poses import inverses
from tactile_records.runs.figures import BELIEF, CONTACT_PICTURES, REFERENCE, SURFACE, TRUTH, message
from tactile_records.runs.metrics import depth_of, largest, loop_rows, percent, rms, task_row, text
from tactile_records.runs.record import RunRecord
from tactile_records.runs.report import Run, TaskReport

Array = NDArray[Any]

TOPPLED_DEG = 30.0  # a body that leans more than this has toppled: no profile stands again from there
WIDTH = 9.0  # inches of the picture
DRAWN_EVERY = 0.040  # m of the pusher's way between two tips in the picture
FOLLOWER, TARGET, TICK = "#8a4fa3", "#d62728", 12.0  # colours; length of a contact normal's tick, mm

FIELDS = {
    **metrics.REPORT_FIELDS,
    "push.error_mm": "perpendicular distance from the target to the contact normal at the end, by the true "
    "normal where it is known, else by the believed one; positive: the target lies to its left",
    "push.error_abs_mm": "its absolute value, as the paper's tables have it",
    "push.error_true_mm": "the same by the true normal",
    "push.error_believed_mm": "the same by the believed normal",
    "push.error_axis_mm": "the same by the sensor's own axis",
    "push.direction_error_deg": "angle from the goal's direction to the sensor's axis at the end; positive: "
    "the axis points to its left; null: the goal has none",
    "push.distance_mm": "distance from the centre of the tip to the target at the end",
    "push.shear_max_mm": "largest true shear (believed, without a truth)",
    "push.tip_depth_max_mm": "largest true depth (believed, without a truth)",
    "push.body_way_mm": "way of the pushed body's origin over the floor",
    "push.body_turned_deg": "turn of the pushed body about the vertical, from start to end",
    "push.body_tilt_max_deg": "largest lean of the pushed body",
    "push.toppled": f"whether it leans more than {TOPPLED_DEG:g} degrees at some time",
    "push.follower": "name of the arm that keeps to the other side; null: there is none",
    "push.follower_contact_fraction": "part of the push in which it has true contact (0..1)",
    "push.follower_depth_rms_mm": "RMS of its true depth less its reference",
}


@dataclass(frozen=True)
class Contacts:
    """The contacts of a sensor over some time: (N,) rows, seen from above in mm.

    Attributes
    ----------
    center : ndarray (N, 2)
        The tip's centre.
    axis, normal : ndarray (N, 2)
        Directions of the sensor's axis and of the contact normal, into the body; unit vectors.
    depth, shear : ndarray (N,)
    """

    stamp_ns: Array
    center: Array
    axis: Array
    normal: Array
    depth: Array
    shear: Array

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def error(self, target: Array, normal: Array | None = None) -> Array:
        """Signed distances (N,) of a target (2,) from the lines along the normals (or those given)."""
        along, way = self.normal if normal is None else normal, target - self.center
        return along[:, 0] * way[:, 1] - along[:, 1] * way[:, 0]


def contacts(record: RunRecord, stamp_ns: Array, X_fs: Array, true: bool = False) -> Contacts:
    """Contacts of an arm with these contact poses (N, 4, 4) at these stamps; of the `true` sensor."""
    T = record.T_world_base @ record.pose.at(stamp_ns)
    T = T @ record.T_controlled_sensor if true else T
    inward = np.einsum("nij,nj->ni", T[:, :3, :3], X_fs[:, 2, :3])  # {f}'s z axis in the world
    return Contacts(
        stamp_ns,
        T[:, :2, 3] * 1e3,
        _from_above(T[:, :2, 2]),
        _from_above(inward[:, :2]),
        depth_of(X_fs) * 1e3,
        np.linalg.norm(X_fs[:, :2, 3], axis=1) * 1e3,
    )


def _from_above(v: Array) -> Array:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12)


def true_contacts(record: RunRecord) -> Contacts:
    """While at work and in contact, by the simulation's truth."""
    rows = record.truth.rows(record.working(record.truth.stamp_ns) & record.truth.in_contact)
    return contacts(record, *_within(record, rows.stamp_ns, rows.T_fs), true=True)


def believed_contacts(record: RunRecord) -> Contacts:
    """While at work, as the filter believes."""
    rows = record.belief.rows(record.working(record.belief.stamp_ns))
    return contacts(record, *_within(record, rows.stamp_ns, inverses(rows.mean)))


def _within(record: RunRecord, stamp_ns: Array, X_fs: Array) -> tuple[Array, Array]:
    """Those between the first and the last pose that the arm has told."""
    if len(record.pose) < 2:
        return stamp_ns[:0], X_fs[:0]
    inside = (stamp_ns >= record.pose.stamp_ns[0]) & (stamp_ns <= record.pose.stamp_ns[-1])
    return stamp_ns[inside], X_fs[inside]


def target_of(record: RunRecord) -> Array:
    """The target of the last goal (2,), seen from above in mm; NaN where there is none."""
    known = record.targets[np.isfinite(record.targets).all(axis=1)]
    if not len(known):
        return np.full(2, np.nan)
    return np.asarray(record.T_world_base[:3, :3] @ known[-1] + record.T_world_base[:3, 3])[:2] * 1e3


def body_poses(record: RunRecord) -> tuple[Array, Array, bool]:
    """Stamps (N,) and poses (N, 4, 4) of the pushed body in the world at work, and whether they are true.

    Where nobody knows them they are indicative: the body as if it stuck to the believed contact from where
    the scene has it at the start. None where the scene does not say what is pushed.
    """
    body = record.body.rows(record.working(record.body.stamp_ns))
    if len(body):
        return body.stamp_ns, body.T_world_body, True
    belief = record.belief.rows(record.working(record.belief.stamp_ns))
    if not len(belief) or not len(record.loose.outline) or len(record.pose) < 2:
        return np.zeros(0, np.int64), np.zeros((0, 4, 4)), False
    stamps, X_fs = _within(record, belief.stamp_ns, inverses(belief.mean))
    T_world_contact = record.T_world_base @ record.pose.at(stamps) @ inverses(X_fs)
    return stamps, T_world_contact @ (se3.inverse(T_world_contact[0]) @ record.loose.T_world_start), False


def follower_of(record: RunRecord, run: Run) -> RunRecord | None:
    """The arm that tracks the other side of what this one pushes, if there is one."""
    others = [other for name, other in run.items() if name != record.arm and other.task == "object_tracking"]
    return others[0] if len(others) == 1 else None


# ---- numbers ----


def numbers(record: RunRecord, run: Run) -> dict[str, Any]:
    """All numbers of the arm that pushes."""
    return metrics.report(record) | {"push": push_numbers(record, run)}


def push_numbers(record: RunRecord, run: Run) -> dict[str, Any]:
    """Those of the push itself: the fields `push.*`."""
    target, true, believed = target_of(record), true_contacts(record), believed_contacts(record)
    known = true if len(true) else believed
    by_truth, by_belief = _last(true.error(target)), _last(believed.error(target))
    error = by_truth if np.isfinite(by_truth) else by_belief
    return {
        "error_mm": error,
        "error_abs_mm": abs(error),
        "error_true_mm": by_truth,
        "error_believed_mm": by_belief,
        "error_axis_mm": _last(known.error(target, known.axis)),
        "direction_error_deg": _direction_error(record, known),
        "distance_mm": _last(np.linalg.norm(target - known.center, axis=1)),
        "shear_max_mm": largest(known.shear),
        "tip_depth_max_mm": largest(known.depth),
        **_body_numbers(record),
        **_follower_numbers(record, run),
    }


def _direction_error(record: RunRecord, known: Contacts) -> float | None:
    wanted = record.directions[np.isfinite(record.directions).all(axis=1)]
    if not len(wanted) or not len(known):
        return None
    x, y = (record.T_world_base[:3, :3] @ wanted[-1])[:2]
    axis = known.axis[-1]
    return float(np.degrees(np.arctan2(x * axis[1] - y * axis[0], x * axis[0] + y * axis[1])))


def _last(values: Array) -> float:
    return float(values[-1]) if len(values) else np.nan


def _body_numbers(record: RunRecord) -> dict[str, Any]:
    _, T, true = body_poses(record)
    if not true:
        return dict.fromkeys(("body_way_mm", "body_turned_deg", "body_tilt_max_deg", "toppled"))
    upright = record.body.T_world_body[0, :3, :3].T[:, 2]  # the world's z in the body, at the start
    tilt = np.degrees(np.arccos(np.clip(record.body.T_world_body[:, 2, :3] @ upright, -1.0, 1.0)))
    turned = T[-1, :3, :3] @ T[0, :3, :3].T
    return {
        "body_way_mm": float(np.linalg.norm(np.diff(T[:, :2, 3], axis=0), axis=1).sum()) * 1e3,
        "body_turned_deg": float(np.degrees(np.arctan2(turned[1, 0], turned[0, 0]))),
        "body_tilt_max_deg": largest(tilt),
        "toppled": bool(largest(tilt) > TOPPLED_DEG),
    }


def _follower_numbers(record: RunRecord, run: Run) -> dict[str, Any]:
    other = follower_of(record, run)
    if other is None:
        return {"follower": None, "follower_contact_fraction": None, "follower_depth_rms_mm": None}
    truth = other.truth.rows(record.working(other.truth.stamp_ns))
    error = depth_of(truth.T_fs) - other.reference_at(truth.stamp_ns)[:, 2] if len(truth) else np.zeros(0)
    return {
        "follower": other.arm,
        "follower_contact_fraction": metrics.mean(truth.in_contact),
        "follower_depth_rms_mm": rms(error) * 1e3,
    }


def _direction_row(error: float | None) -> list[tuple[str, str, str]]:
    return [] if error is None else [("from the goal's direction", text(error, "deg", 1), "")]


def summary(values: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """What a person wants to see first."""
    push = values["push"]
    toppled = {None: "unknown", False: "no", True: "yes"}[push["toppled"]]
    ended = "" if values["succeeded"] else f", {text(push['distance_mm'], 'mm', 0)} before it"
    rows = [
        task_row(values),
        ("target to contact normal", text(push["error_mm"], "mm", 2) + ended, ""),
        ("by the believed normal", text(push["error_believed_mm"], "mm", 2), ""),
        ("tip's centre to target", text(push["distance_mm"], "mm", 1), ""),
        *_direction_row(push["direction_error_deg"]),
        ("time of the push", text(values["work_s"], "s", 1), ""),
        ("contact kept", percent(values["contact_fraction"]), "100 %"),
        ("largest shear", text(push["shear_max_mm"], "mm", 2), ""),
        ("largest depth", text(push["tip_depth_max_mm"], "mm", 2), ""),
        ("toppled", toppled, "no"),
    ]
    if push["follower"] is not None:
        rows += [
            (f"{push['follower']}: contact kept", percent(push["follower_contact_fraction"]), "100 %"),
            (f"{push['follower']}: depth RMS", text(push["follower_depth_rms_mm"], "mm", 2), ""),
        ]
    return rows + loop_rows(values)


# ---- pictures ----


def from_above(record: RunRecord, run: Run) -> Figure:
    """The paper's picture: the sensors' poses, the body's outline on its way, the target, contact normals."""
    pusher = true_contacts(record)
    pusher = pusher if len(pusher) else believed_contacts(record)
    if not len(pusher):
        return message("the run did not come to pushing: there is nothing to show")
    figure, axes = plt.subplots(layout="constrained")
    chosen = _every(pusher.center, DRAWN_EVERY * 1e3)
    _draw_body(axes, record, pusher.stamp_ns[chosen])
    arms = [(record, pusher, BELIEF)]
    other = follower_of(record, run)
    if other is not None:
        arms.append((other, _meanwhile(record, other), FOLLOWER))
    for arm, found, color in arms:
        if len(found):
            nearest = np.clip(np.searchsorted(found.stamp_ns, pusher.stamp_ns[chosen]), 0, len(found) - 1)
            _draw_tips(axes, found, np.unique(nearest), arm.tip_radius * 1e3, color, arm.arm)
    target = target_of(record)
    axes.add_patch(Circle(tuple(target), 4.0, fc="none", ec=TARGET, lw=2.2, zorder=9))
    axes.plot([], [], "o", mfc="none", color=TARGET, mew=2.2, label="target")
    axes.set_aspect("equal")
    axes.set(xlabel="x [mm]", ylabel="y [mm]", title=_title(record, pusher, target))
    axes.legend(loc="best")
    wide, high = (np.ptp(limits) for limits in (axes.get_xlim(), axes.get_ylim()))
    figure.set_size_inches(WIDTH, float(np.clip(WIDTH * high / wide, 0.4 * WIDTH, WIDTH)))
    return figure


def _title(record: RunRecord, pusher: Contacts, target: Array) -> str:
    return (
        f"{record.scene}: the push from above; at the end the target is "
        f"{abs(_last(pusher.error(target))):.1f} mm off the contact normal"
    )


def _every(center: Array, distance: float) -> Array:
    """Rows at every so many mm of the way, and the last."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(center, axis=0), axis=1))])
    return np.unique(np.append(np.searchsorted(way, np.arange(0.0, way[-1], distance)), len(center) - 1))


def _meanwhile(record: RunRecord, other: RunRecord) -> Contacts:
    """The contacts of another arm while this one is at work."""
    truth = other.truth.rows(record.working(other.truth.stamp_ns) & other.truth.in_contact)
    if len(truth):
        return contacts(other, *_within(other, truth.stamp_ns, truth.T_fs), true=True)
    belief = other.belief.rows(record.working(other.belief.stamp_ns))
    return contacts(other, *_within(other, belief.stamp_ns, inverses(belief.mean)))


def _draw_body(axes: Any, record: RunRecord, stamps: Array) -> None:
    """The outline at start and end, and faint where the tips are drawn."""
    known, T, true = body_poses(record)
    if not len(known) or not len(record.loose.outline):
        return
    label = "pushed body, start and end" if true else "pushed body, start and end (indicative)"
    rows = np.unique(np.clip(np.searchsorted(known, stamps), 0, len(known) - 1))
    for row in rows:
        outline = (record.loose.outline @ T[row, :3, :3].T + T[row, :3, 3])[:, :2] * 1e3
        ends = row in (rows[0], rows[-1])
        if ends:
            axes.fill(*outline.T, fc=SURFACE, ec="none", alpha=0.6, zorder=1)
        axes.plot(
            *outline.T, color="#7d7564", lw=1.8 if ends else 0.7, alpha=1.0 if ends else 0.45, zorder=2,
            solid_capstyle="butt", label=label if row == rows[0] else None,
        )  # fmt: skip


def _draw_tips(axes: Any, found: Contacts, rows: Array, radius: float, color: str, name: str) -> None:
    """The path of the tip's centre; at some places the tip's outline with a tick along the contact normal."""
    axes.plot(*found.center.T, color=color, lw=1.6, zorder=5, label=f"{name}: tip's centre")
    sweep = np.radians(np.linspace(-90.0, 90.0, 41))
    for row in rows:
        center, axis = found.center[row], found.axis[row]
        side = np.array([-axis[1], axis[0]])
        dome = center + radius * (np.cos(sweep)[:, None] * axis + np.sin(sweep)[:, None] * side)
        stem = [dome[0] - 1.2 * radius * axis, *dome, dome[-1] - 1.2 * radius * axis]
        axes.plot(*np.array(stem).T, color=color, lw=0.9, alpha=0.7, zorder=4)
        touched = center + (radius - found.depth[row]) * found.normal[row]
        ends = np.stack([touched - TICK * found.normal[row], touched + TICK * found.normal[row]])
        axes.plot(*ends.T, color=TRUTH, lw=1.4, zorder=6)
        axes.plot(*center, "o", color=color, ms=3, zorder=7)
    axes.plot([], [], color=TRUTH, lw=1.4, label="contact normal" if color == BELIEF else None)


def errors(record: RunRecord, run: Run) -> Figure:
    """Distance from the target to the contact normal, depth and shear, on the way to the target."""
    target = target_of(record)
    lines = [(believed_contacts(record), BELIEF, "believed"), (true_contacts(record), TRUTH, "true")]
    if not any(len(found) for found, _, _ in lines):
        return message("the run did not come to pushing: there is nothing to show")
    figure, (error, depth, shear) = plt.subplots(
        3, 1, figsize=(10, 9), sharex=True, height_ratios=[1.6, 1, 1], layout="constrained"
    )
    for found, color, name in lines:
        if len(found):
            left = np.linalg.norm(target - found.center, axis=1)
            error.plot(left, found.error(target), color=color, lw=1.0, label=f"{name} normal")
            depth.plot(left, found.depth, color=color, lw=1.0)
            shear.plot(left, found.shear, color=color, lw=1.0)
    error.axhline(0.0, color=REFERENCE, ls="--", lw=1.2)
    error.set(ylabel="target to contact normal [mm]", title=f"{record.scene}: on the way to the target")
    error.legend()
    depth.set(ylabel="depth [mm]")
    shear.set(ylabel="shear [mm]", xlabel="distance of the tip's centre from the target [mm]")
    shear.invert_xaxis()
    return figure


REPORT = TaskReport(
    fields=FIELDS,
    numbers=numbers,
    summary=summary,
    pictures={"push.png": from_above, "push_errors.png": errors, **CONTACT_PICTURES},
)
