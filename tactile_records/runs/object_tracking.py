"""Object tracking: numbers and pictures of a follower that tracks what a leader moves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from tactile_records.runs import metrics
from tactile_records.runs.euler_poses import COMPONENTS, UNITS
from tactile_records.runs.figures import AXES, BELIEF, CONTACT_PICTURES, REFERENCE, TRUTH, message
from tactile_records.runs.metrics import largest, loop_rows, percent, rms, task_row, text
from tactile_records.runs.record import RunRecord
from tactile_records.runs.report import Run, TaskReport
from tactile_records.runs.tracking import Tracking, leader_of, tracking

Array = NDArray[Any]

POSITION_REQUIREMENT, ANGLE_REQUIREMENT = 2.0, 1.5  # mm, deg: RMS of each component
LIMITS = {name: POSITION_REQUIREMENT if name in "xyz" else ANGLE_REQUIREMENT for name in COMPONENTS}
NOT_KEPT = "it ended, but did not keep "  # begins the reason of a run that ended well otherwise
LENGTH, TRIADS = 22.0, 12  # mm, and how many along each goal: axes that are drawn of a pose
LABELS = ("x [mm]", "y [mm]", "z [mm]", "α [deg]", "β [deg]", "γ [deg]")

FIELDS = {
    **metrics.REPORT_FIELDS,
    "tracking.leader": "name of the arm that moves the object; null: there is none in the run",
    "tracking.seconds": "time in which the leader moves and the follower tracks",
    "tracking.leader_speed_mm_s": "largest speed of the follower's place on what the leader moves",
    "tracking.leader_speed_deg_s": "its largest angular speed",
    "tracking.rms.*": "RMS error by component, in the frame of the sensor as it should be (mm, deg)",
    "tracking.beyond": "components whose RMS error is beyond 2 mm or 1.5 deg; then it has not succeeded",
    "tracking.largest.*": "largest error by component (mm, deg)",
    "tracking.goals.*.rms.*": "RMS error while the leader was at this goal",
    "tracking.lag_ms": "delay of the follower's velocity, by cross-correlation",
    "tracking.angular_lag_ms": "delay of its angular velocity",
}


def numbers(record: RunRecord, run: Run) -> dict[str, Any]:
    """All numbers of the follower; it has not succeeded where it has not kept a component."""
    values = metrics.report(record) | {"tracking": _tracking_numbers(record, run)}
    if values["succeeded"] and (lost := values["tracking"].get("beyond")):
        values |= {"succeeded": False, "reason": NOT_KEPT + _errors_of(lost, values["tracking"]["rms"])}
    return values


def _errors_of(names: list[str], errors: Mapping[str, float]) -> str:
    """Components in words, with their RMS errors and limits: "gamma (74.1 deg RMS, must stay below 1.5)"."""
    said = []
    for name in names:
        measured = text(errors[name], "mm" if name in "xyz" else "deg", 1)
        said.append(f"{name} ({measured} RMS, must stay below {LIMITS[name]:g})")
    return ", ".join(said)


def _tracking_numbers(record: RunRecord, run: Run) -> dict[str, Any]:
    leader = leader_of(record, run)
    if leader is None:
        return {"leader": None}
    track = tracking(record, leader)
    error = track.error * UNITS
    lag, angular_lag = track.lag()
    speed, angular_speed = _speeds(track)
    return {
        "leader": leader.arm,
        "seconds": metrics.duration(track.stamp_ns),
        "leader_speed_mm_s": speed,
        "leader_speed_deg_s": angular_speed,
        "rms": dict(zip(COMPONENTS, map(rms, error.T), strict=True)),
        "beyond": [name for k, name in enumerate(COMPONENTS) if rms(error[:, k]) > LIMITS[name]],
        "largest": dict(zip(COMPONENTS, map(largest, np.abs(error.T)), strict=True)),
        "goals": {
            name: {"rms": dict(zip(COMPONENTS, map(rms, error[track.goal == index].T), strict=True))}
            for index, name in enumerate(track.goals)
        },
        "lag_ms": lag * 1e3,
        "angular_lag_ms": angular_lag * 1e3,
    }


def _speeds(track: Tracking) -> tuple[float, float]:
    """Largest speed (mm/s) and angular speed (deg/s) of the target, over a tenth of a second each."""
    if len(track) < 2:
        return np.nan, np.nan
    stride = max(1, round(0.1e9 / np.median(np.diff(track.stamp_ns))))
    T, seconds = track.T_world_target[::stride], track.stamp_ns[::stride] * 1e-9
    if len(T) < 2:
        return np.nan, np.nan
    dt = np.diff(seconds)
    way = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    turned = np.einsum("nji,njk->nik", T[:-1, :3, :3], T[1:, :3, :3])
    angle = np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0))
    return float((way / dt).max()) * 1e3, float(np.degrees(angle / dt).max())


def summary(values: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """What a person wants to see first."""
    track = values["tracking"]
    task, said, wanted = task_row(values)
    if track.get("beyond") and (values["succeeded"] or values["reason"].startswith(NOT_KEPT)):
        said = f"ended, but {', '.join(track['beyond'])} not kept"
    rows = [(task, said, wanted), ("contact kept", percent(values["contact_fraction"]), "100 %")]
    if track["leader"] is not None:
        for name in COMPONENTS:
            unit, limit = "mm" if name in "xyz" else "deg", LIMITS[name]
            measured = f"{text(track['rms'][name], unit, 2)}, {text(track['largest'][name], unit, 2)}"
            rows.append((f"error {name} RMS, largest", measured, f"<= {limit:g} {unit}"))
        rows += [
            ("lag", text(track["lag_ms"], "ms", 0), ""),
            ("lag in rotation", text(track["angular_lag_ms"], "ms", 0), ""),
        ]
    return rows + loop_rows(values)


def _tracking(record: RunRecord, run: Run) -> Tracking | None:
    leader = leader_of(record, run)
    track = None if leader is None else tracking(record, leader)
    return track if track is not None and len(track) else None


def _nothing(record: RunRecord, run: Run) -> str:
    """Why there is nothing to compare with."""
    if leader_of(record, run) is None:
        return "no arm carries what this one follows"
    return "no leader moved while this arm tracked"


def poses(record: RunRecord, run: Run) -> Figure:
    """Leader and follower in three dimensions along the path, a panel for each of the leader's goals."""
    track = _tracking(record, run)
    if track is None:
        return message(f"{_nothing(record, run)}: there are no poses to compare")
    indices = [int(index) for index in np.unique(track.goal)]
    columns = min(3, len(indices))
    rows = -(-len(indices) // columns)
    figure = plt.figure(figsize=(6.0 * columns + 2.0, 6.0 * rows), layout="constrained")
    for number, index in enumerate(indices):
        axes = figure.add_subplot(rows, columns, number + 1, projection="3d")
        chosen = np.flatnonzero(track.goal == index)
        _draw_goal(axes, track, chosen)
        axes.set_title(track.goals[index])
    figure.suptitle(f"{record.scene}: poses of leader and follower", weight="bold")
    return figure


def _draw_goal(axes: Any, track: Tracking, chosen: Array) -> None:
    both = (track.T_world_leader, TRUTH, "leader"), (track.T_world_follower, BELIEF, "follower")
    for T_all, color, name in both:
        T = T_all[chosen]
        axes.plot(*(T[:, :3, 3] * 1e3).T, color=color, lw=1.6, label=name)
        for pose in T[np.linspace(0, len(T) - 1, TRIADS).astype(int)]:
            origin = pose[:3, 3] * 1e3
            for k, axis_color in enumerate(AXES):
                ends = np.stack([origin, origin + LENGTH * pose[:3, k]])
                axes.plot(*ends.T, color=axis_color, lw=1.1)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
    axes.set_aspect("equal")
    spans = [np.ptp(limits) for limits in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    for axis, span in zip((axes.xaxis, axes.yaxis, axes.zaxis), spans, strict=True):
        axis.set_major_locator(MaxNLocator(2 if span < 0.5 * max(spans) else 5))  # short sides have no room
    axes.legend(loc="upper left")


def errors(record: RunRecord, run: Run) -> Figure:
    """Error by component over time, with the leader's goals one after the other."""
    track = _tracking(record, run)
    if track is None:
        return message(f"{_nothing(record, run)}: there is no error to show")
    error, seconds = track.error * UNITS, (track.stamp_ns - track.stamp_ns[0]) * 1e-9
    figure, panels = plt.subplots(3, 2, figsize=(13, 9), sharex=True, layout="constrained")
    changes = np.flatnonzero(np.diff(track.goal)) + 1
    for k, (label, axes) in enumerate(zip(LABELS, panels.T.ravel(), strict=True)):
        limit = POSITION_REQUIREMENT if k < 3 else ANGLE_REQUIREMENT
        axes.axhspan(-limit, limit, color=REFERENCE, alpha=0.10, lw=0)
        axes.plot(seconds, error[:, k], color=BELIEF, lw=1.2)
        worst = largest(np.abs(error[:, k]))
        axes.set(ylabel=label, title=f"RMS {rms(error[:, k]):.2f}, largest {worst:.2f}")
        for change in changes:
            axes.axvline(seconds[change], color="#999999", lw=0.8, ls=":")
    for axes in panels[-1]:
        axes.set_xlabel("time since the leader began to move [s]")
    names = ", ".join(track.goals[int(index)] for index in np.unique(track.goal))
    title = f"{record.scene}: error of the follower in the frame in which it should be ({names})"
    figure.suptitle(title, weight="bold")
    return figure


REPORT = TaskReport(
    fields=FIELDS,
    numbers=numbers,
    summary=summary,
    pictures={"poses.png": poses, "errors.png": errors, **CONTACT_PICTURES},
)
