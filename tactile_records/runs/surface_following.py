"""Surface following: what a person wants to see first of a run, and the picture of its paths."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_records.runs import figures, metrics
from tactile_records.runs.figures import AXES, BELIEF, REFERENCE, SURFACE, TRUTH, reference_of
from tactile_records.runs.metrics import loop_rows, normal_angle, percent, task_row, text
from tactile_records.runs.record import RunRecord
from tactile_records.runs.report import TaskReport

Array = NDArray[Any]

_WELL = (
    "When all is well, the sensor's axis lies along the normal, and depth and angle stay in the green bands."
)
DEPTH_REQUIREMENT, NORMAL_REQUIREMENT = 0.3, 2.0  # mm, deg: what the runs are held to


def summary_rows(values: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """What a person wants to see first: (name, value with unit, requirement where there is one)."""
    required = ("as set", "as set") if values["source"] == "offline" else ("<= 8 ms", "<= 25 ms")
    return [
        task_row(values),
        ("path followed", text(values["path_length_mm"], "mm", 1), ""),
        ("contact kept", percent(values["contact_fraction"]), "100 %"),
        ("depth RMS about reference", text(values["depth_rms_mm"], "mm", 3), "<= 0.3 mm"),
        ("normal alignment RMS", text(values["normal_rms_deg"], "deg", 2), "<= 2 deg"),
        ("oscillation in depth", text(values["oscillation"]["depth_mm"], "mm", 3), ""),
        ("depth error of belief RMS", text(values["belief"]["depth_rms_mm"], "mm", 3), ""),
        *loop_rows(values, *required),
    ]


@dataclass(frozen=True)
class _Track:
    """One path while following: the sensor's poses and, where known, the truth at the same time.

    Attributes
    ----------
    distance : ndarray (N,) arc length at each pose, m
    depth, angle : ndarray (M,) true depth (m) and angle to the normal (rad), at `truth_distance` (M,)
    """

    name: str
    T: Array
    distance: Array
    truth_distance: Array
    truth_T: Array
    T_fs: Array
    depth: Array
    angle: Array


def trajectory(record: RunRecord) -> Figure:
    """The sensor over the true surface: from the side for one path, in three dimensions for several."""
    tracks = list(_tracks(record))
    if not tracks:
        return figures.message("the run did not come to following: there is no path to show")
    return _side_view(record, tracks[0]) if len(tracks) == 1 else _three_dimensional(record, tracks)


def _tracks(record: RunRecord) -> Iterator[_Track]:
    pose, truth = record.pose, record.truth
    following = record.working(pose.stamp_ns)
    path_of_pose, path_of_truth = record.goal_at(pose.stamp_ns), record.goal_at(truth.stamp_ns)
    truth_following = record.working(truth.stamp_ns)
    for index in np.unique(path_of_pose[following]):
        rows = pose.rows(following & (path_of_pose == index))
        steps = np.linalg.norm(np.diff(rows.T_base_sensor[:, :3, 3], axis=0), axis=1)
        distance = np.concatenate([[0.0], np.cumsum(steps)])
        true = truth.rows(truth_following & (path_of_truth == index))
        nearest = np.clip(np.searchsorted(rows.stamp_ns, true.stamp_ns), 0, len(rows) - 1)
        name = record.goals[index] if 0 <= index < len(record.goals) else f"path {index}"
        yield _Track(
            name,
            rows.T_base_sensor,
            distance,
            np.interp(true.stamp_ns, rows.stamp_ns, distance),
            rows.T_base_sensor[nearest],
            true.T_fs,
            true.T_fs[:, 2, 3],
            normal_angle(true.T_fs, record.reference_at(true.stamp_ns)),
        )


def _side_view(record: RunRecord, track: _Track) -> Figure:
    figure, (side, depth, angle) = plt.subplots(
        3, 1, figsize=(11, 9), sharex=True, height_ratios=[1.9, 1, 1], layout="constrained"
    )
    origin, along = _line(track.T)
    s = (track.T[:, :3, 3] - origin) @ along * 1e3
    _draw_profile(side, record, origin, along, s)
    side.plot(s, track.T[:, 2, 3] * 1e3, color=BELIEF, lw=2.0, label="centre of the tip", zorder=4)
    _draw_tips(side, record, track, origin, along)
    side.set(ylabel="height [mm]", title=f"{record.scene}: the sensor along the true surface, from the side")
    side.set_aspect("equal", adjustable="datalim")
    side.legend(loc="upper right", ncols=2)
    at = np.interp(track.truth_distance, track.distance, s)
    _draw_depth(depth, record, at, track.depth, TRUTH)
    _draw_angle(angle, at, track.angle, TRUTH)
    angle.set_xlabel("distance along the path, horizontally [mm]")
    figures.caption(figure, _WELL)
    return figure


def _line(T: Array) -> tuple[Array, Array]:
    """Start of the path and its horizontal direction, both (3,)."""
    way = T[-1, :3, 3] - T[0, :3, 3]
    way[2] = 0.0
    norm = np.linalg.norm(way)
    return T[0, :3, 3], way / norm if norm > 0.0 else np.array([1.0, 0.0, 0.0])


def _draw_profile(axes: Any, record: RunRecord, origin: Array, along: Array, s: Array) -> None:
    """The true surface cut along the path, filled below."""
    if len(record.surface.vertices) == 0:
        return
    from scipy.interpolate import LinearNDInterpolator

    margin = 2.0 * record.tip_radius
    reach = np.linspace(s.min() * 1e-3 - margin, s.max() * 1e-3 + margin, 400)
    height = LinearNDInterpolator(record.surface.vertices[:, :2], record.surface.vertices[:, 2])
    z = height(origin[:2] + reach[:, None] * along[:2]) * 1e3
    inside = np.isfinite(z)
    if not inside.any():
        return
    floor = np.nanmin(z) - 12.0
    axes.fill_between(reach[inside] * 1e3, floor, z[inside], color=SURFACE, lw=0, zorder=1)
    axes.plot(reach[inside] * 1e3, z[inside], color="#7d7564", lw=1.6, label="true surface", zorder=2)


def _draw_tips(axes: Any, record: RunRecord, track: _Track, origin: Array, along: Array) -> None:
    """The tip's outline every 15 mm, with the sensor's axis and the true normal of the surface under it."""
    radius = record.tip_radius * 1e3
    sweep = np.radians(np.linspace(-90.0, 90.0, 61))
    wanted = np.searchsorted(track.truth_distance, np.arange(0.0, track.distance[-1] + 1e-9, 0.015))
    for number, k in enumerate(wanted[wanted < len(track.truth_T)]):
        T, R_fs = track.truth_T[k], track.T_fs[k][:3, :3]
        center = np.array([(T[:3, 3] - origin) @ along, T[2, 3]]) * 1e3
        axis = _in_plane(T[:3, 2], along)
        normal = _in_plane(T[:3, :3] @ R_fs[2], along)  # f's z axis in the base
        side = np.array([-axis[1], axis[0]])
        outline = center + radius * (np.cos(sweep)[:, None] * axis + np.sin(sweep)[:, None] * side)
        axes.plot(*outline.T, color="#9db8d2", lw=0.9, zorder=3)
        depth = track.depth[k] * 1e3
        touched = center + (radius - depth) * normal
        ends = np.stack([touched, touched - (radius + 12.0) * normal])
        axes.plot(*ends.T, color="#8a8a8a", lw=3.2, zorder=4, label=None if number else "true surface normal")
        _arrow(axes, center - 0.45 * radius * axis, center + (radius - depth) * axis, AXES[0])
        axes.plot(*center, "o", color=BELIEF, ms=4, zorder=6)
    axes.plot([], [], color=AXES[0], lw=2.2, label="sensor's axis")


def _in_plane(v: Array, along: Array) -> Array:
    projected = np.array([v @ along, v[2]])
    return projected / max(float(np.linalg.norm(projected)), 1e-12)


def _arrow(axes: Any, start: Array, end: Array, color: str) -> None:
    arrow = {"arrowstyle": "-|>", "color": color, "lw": 1.6, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 9}
    axes.annotate("", xy=end, xytext=start, zorder=5, arrowprops=arrow)


def _draw_depth(axes: Any, record: RunRecord, at: Array, depth: Array, color: Any, **line: Any) -> None:
    reference = reference_of(record)[2] * 1e3
    if not axes.lines:
        axes.axhspan(
            reference - DEPTH_REQUIREMENT, reference + DEPTH_REQUIREMENT, color=REFERENCE, alpha=0.12, lw=0
        )
        axes.axhline(reference, color=REFERENCE, lw=1.2, ls="--", label=f"reference ± {DEPTH_REQUIREMENT} mm")
        axes.set(ylabel="true depth [mm]", ylim=(reference - 0.75, reference + 0.75))
        axes.legend(loc="upper right")
    axes.plot(at, depth * 1e3, color=color, lw=1.4, **line)


def _draw_angle(axes: Any, at: Array, angle: Array, color: Any, **line: Any) -> None:
    if not axes.lines:
        axes.axhspan(0.0, NORMAL_REQUIREMENT, color=REFERENCE, alpha=0.12, lw=0)
        axes.axhline(
            NORMAL_REQUIREMENT, color=REFERENCE, lw=1.2, ls="--", label=f"{NORMAL_REQUIREMENT:g} deg RMS"
        )
        axes.set(ylabel="angle to normal [deg]")
        axes.legend(loc="upper right")
    axes.plot(at, np.degrees(angle), color=color, lw=1.4, **line)
    axes.set_ylim(0.0, max(2.5, axes.get_ylim()[1], 1.1 * float(np.degrees(angle).max(initial=0.0))))


def _three_dimensional(record: RunRecord, tracks: list[_Track]) -> Figure:
    figure = plt.figure(figsize=(13, 7), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=[1.5, 1])
    view = figure.add_subplot(grid[:, 0], projection="3d")
    depth, angle = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    colors = plt.colormaps["hsv"](np.linspace(0.0, 1.0, len(tracks), endpoint=False))
    colors[:, :3] *= 0.85
    _draw_mesh(view, record)
    for track, color in zip(tracks, colors, strict=True):
        _draw_path_3d(view, record, track, color)
        _draw_depth(depth, record, track.truth_distance * 1e3, track.depth, color, label=track.name)
        _draw_angle(angle, track.truth_distance * 1e3, track.angle, color)
    view.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
    view.set_title(f"{record.scene}: the skin's path over the true surface, with the sensor's axis")
    view.set_aspect("equal")
    view.view_init(elev=38, azim=-60)
    view.legend(loc="upper left", ncols=2)
    depth.set_title("depth and alignment along each path")
    angle.set_xlabel("arc length of the tip's centre [mm]")
    figures.caption(figure, _WELL)
    return figure


def _draw_mesh(axes: Any, record: RunRecord) -> None:
    mesh, look = record.surface, {"color": SURFACE, "alpha": 0.45, "lw": 0.1, "edgecolor": "#b8ae9a"}
    if len(mesh.vertices):
        axes.plot_trisurf(*(mesh.vertices * 1e3).T, triangles=mesh.faces, zorder=1, **look)


def _draw_path_3d(axes: Any, record: RunRecord, track: _Track, color: Any) -> None:
    """The point of the tip that is deepest along the axis, and the axis itself every 10 mm."""
    reach = record.tip_radius - reference_of(record)[2]
    tip = (track.T[:, :3, 3] + reach * track.T[:, :3, 2]) * 1e3
    axes.plot(*tip.T, color=color, lw=2.4, label=track.name, zorder=5)
    for k in np.searchsorted(track.distance, np.arange(0.010, track.distance[-1], 0.010)):
        ends = np.stack([tip[k], tip[k] - 18.0 * track.T[k, :3, 2]])
        axes.plot(*ends.T, color=color, lw=1.1, zorder=6)


REPORT = TaskReport(
    fields=metrics.REPORT_FIELDS,
    numbers=lambda record, run: metrics.report(record),
    summary=summary_rows,
    pictures={"trajectory.png": figures.of_one_arm(trajectory), **figures.CONTACT_PICTURES},
)
