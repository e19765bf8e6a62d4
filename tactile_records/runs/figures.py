"""Pictures of a run, from a `RunRecord`: trajectory, contact against the truth, twists, latency.

One colour for one thing in all of them: the truth is black, estimates are orange dots, beliefs blue with a
band of two standard deviations, the reference green. Needs matplotlib; draws without a display.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from tactile_records.runs.euler_poses import euler_poses, euler_sigmas
from tactile_records.runs.metrics import COMMAND_STAGE, inverses, normal_angle
from tactile_records.runs.record import FOLLOW, RunRecord

Array = NDArray[Any]

TRUTH, ESTIMATE, BELIEF, REFERENCE, SURFACE = "#1a1a1a", "#f0a050", "#1f6fb4", "#2e9e4f", "#d9d2c5"
AXES = ("#c8443c", "#3f9c4a", "#3a6fc0")  # x, y, z, as RViz draws them
PHASES = {
    "go_to_start": "#e6e6f2",
    "approach": "#fdf0c9",
    "settle": "#dff0e0",
    "follow": "#ffffff",
    "stopping": "#f6d5d5",
    "retreat": "#ececec",
}
STAGES = ("#8fbbd9", "#5b95c4", "#1f6fb4", "#0b3c68", "#7a5195", "#bc5090")
STYLE: dict[Any, Any] = {
    "figure.dpi": 110,
    "savefig.dpi": 150,
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": True,
    "legend.framealpha": 0.85,
    "legend.edgecolor": "none",
    "legend.fontsize": 9,
}
DEPTH_REQUIREMENT, NORMAL_REQUIREMENT = 0.3, 2.0  # mm, deg: what the runs are held to
LATENCY_REQUIREMENT = {"p50": 8.0, "p99": 25.0}  # ms


def write_figures(record: RunRecord, folder: str | Path) -> list[Path]:
    """Write trajectory.png, contact.png, twists.png and latency.png; returns their paths."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    pictures: dict[str, Callable[[RunRecord], Figure]] = {
        "trajectory.png": trajectory,
        "contact.png": contact,
        "twists.png": twists,
        "latency.png": latency,
    }
    paths = []
    for name, draw in pictures.items():
        with style():
            figure = draw(record)
            figure.savefig(folder / name)
            plt.close(figure)
        paths.append(folder / name)
    return paths


@contextmanager
def style() -> Iterator[None]:
    """The look of all pictures."""
    with plt.rc_context(STYLE):
        yield


# ---- trajectory ----


@dataclass(frozen=True)
class _Track:
    """One path while following: the sensor's poses and, where known, the truth at the same time.

    Attributes
    ----------
    distance : ndarray (N,)
        Arc length at each pose, m.
    depth, angle : ndarray (M,)
        True depth (m) and angle to the normal (rad), at `truth_distance` (M,).
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
        return _message("the run did not come to following: there is no path to show")
    return _side_view(record, tracks[0]) if len(tracks) == 1 else _three_dimensional(record, tracks)


def _tracks(record: RunRecord) -> Iterator[_Track]:
    pose, truth = record.pose, record.truth
    following = record.phase_at(pose.stamp_ns) == FOLLOW
    path_of_pose, path_of_truth = record.path_at(pose.stamp_ns), record.path_at(truth.stamp_ns)
    truth_following = record.phase_at(truth.stamp_ns) == FOLLOW
    for index in np.unique(path_of_pose[following]):
        rows = pose.rows(following & (path_of_pose == index))
        steps = np.linalg.norm(np.diff(rows.T_base_sensor[:, :3, 3], axis=0), axis=1)
        distance = np.concatenate([[0.0], np.cumsum(steps)])
        true = truth.rows(truth_following & (path_of_truth == index))
        nearest = np.clip(np.searchsorted(rows.stamp_ns, true.stamp_ns), 0, len(rows) - 1)
        name = record.paths[index] if 0 <= index < len(record.paths) else f"path {index}"
        yield _Track(
            name,
            rows.T_base_sensor,
            distance,
            np.interp(true.stamp_ns, rows.stamp_ns, distance),
            rows.T_base_sensor[nearest],
            true.T_fs,
            true.T_fs[:, 2, 3],
            normal_angle(true.T_fs, record.reference),
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
    reference = record.reference[2] * 1e3
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
    colors = plt.colormaps["hsv"](np.linspace(0.0, 1.0, len(tracks), endpoint=False)) * [
        0.85,
        0.85,
        0.85,
        1.0,
    ]
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
    return figure


def _draw_mesh(axes: Any, record: RunRecord) -> None:
    mesh = record.surface
    if len(mesh.vertices) == 0:
        return
    axes.plot_trisurf(
        *(mesh.vertices * 1e3).T,
        triangles=mesh.faces,
        color=SURFACE,
        alpha=0.45,
        lw=0.1,
        edgecolor="#b8ae9a",
        zorder=1,
    )


def _draw_path_3d(axes: Any, record: RunRecord, track: _Track, color: Any) -> None:
    """The point of the tip that is deepest along the axis, and the axis itself every 10 mm."""
    reach = record.tip_radius - record.reference[2]
    tip = (track.T[:, :3, 3] + reach * track.T[:, :3, 2]) * 1e3
    axes.plot(*tip.T, color=color, lw=2.4, label=track.name, zorder=5)
    for k in np.searchsorted(track.distance, np.arange(0.010, track.distance[-1], 0.010)):
        ends = np.stack([tip[k], tip[k] - 18.0 * track.T[k, :3, 2]])
        axes.plot(*ends.T, color=color, lw=1.1, zorder=6)


# ---- contact ----


def contact(record: RunRecord) -> Figure:
    """Depth, shear and angles: truth, estimates, beliefs with two standard deviations, while in contact."""
    clock = _ContactClock(record)
    if not clock.stretches:
        return _message("the run did not come to settling: there is no contact to show")
    figure, panels = plt.subplots(3, 2, figsize=(13, 9), sharex=True, layout="constrained")
    rows = (("z", "x"), ("alpha", "y"), ("beta", "gamma"))
    for line, names in zip(panels, rows, strict=True):
        for axes, name in zip(line, names, strict=True):
            _draw_component(axes, record, clock, name)
    panels[0, 0].legend(loc="lower right", ncols=2)
    for axes in panels[-1]:
        axes.set_xlabel(
            "time in contact [s]" + (", paths one after the other" if len(record.paths) > 1 else "")
        )
    figure.suptitle(f"{record.scene}: surface contact pose, settling (shaded) and following", weight="bold")
    return figure


COMPONENTS = {  # name: column of the Euler pose, unit, factor from SI, what it is
    "x": (0, "mm", 1e3, "shear x"),
    "y": (1, "mm", 1e3, "shear y"),
    "z": (2, "mm", 1e3, "depth z"),
    "alpha": (3, "deg", 180.0 / np.pi, "angle α"),
    "beta": (4, "deg", 180.0 / np.pi, "angle β"),
    "gamma": (5, "deg", 180.0 / np.pi, "shear γ"),
}


class _ContactClock:
    """Time that runs only while settling or following: the paths one after the other, with small gaps."""

    GAP = 0.5  # s

    def __init__(self, record: RunRecord) -> None:
        stamps, phases, paths = record.command.stamp_ns, record.command.phase, record.command.path
        self.stretches: list[tuple[int, int, float, str, int]] = []  # from, to (ns), begin (s), phase, path
        begin, last_path = 0.0, None
        change = np.flatnonzero((phases[1:] != phases[:-1]) | (paths[1:] != paths[:-1])) + 1
        for first, end in zip(np.r_[0, change], np.r_[change, len(phases)], strict=True):
            if end <= first or phases[first] not in ("settle", FOLLOW):
                continue
            begin += self.GAP if last_path not in (None, paths[first]) else 0.0
            stop = stamps[min(end, len(stamps) - 1)]
            self.stretches.append((stamps[first], stop, begin, str(phases[first]), int(paths[first])))
            begin += (stop - stamps[first]) * 1e-9
            last_path = paths[first]

    def __call__(self, stamp_ns: Array) -> Array:
        """Seconds for each stamp, NaN outside contact."""
        seconds = np.full(len(stamp_ns), np.nan)
        for first, stop, begin, _, _ in self.stretches:
            inside = (stamp_ns >= first) & (stamp_ns < stop)
            seconds[inside] = begin + (stamp_ns[inside] - first) * 1e-9
        return seconds


def _draw_component(axes: Any, record: RunRecord, clock: _ContactClock, name: str) -> None:
    column, unit, factor, what = COMPONENTS[name]
    for first, stop, begin, phase, _ in clock.stretches:
        if phase == "settle":
            axes.axvspan(begin, begin + (stop - first) * 1e-9, color=PHASES["settle"], lw=0, zorder=0)
    if name in ("z", "alpha", "beta"):
        axes.axhline(record.reference[column] * factor, color=REFERENCE, ls="--", lw=1.2, label="reference")
    estimate = record.estimate
    t, at = _by_time(clock, estimate.stamp_ns)
    values = euler_poses(inverses(estimate.mean[at]))[:, column] * factor
    axes.plot(t, values, ".", color=ESTIMATE, ms=2.0, alpha=0.6, label="estimate", zorder=2)
    t, at = _by_time(clock, record.belief.stamp_ns)
    belief = record.belief.rows(at)
    mean = euler_poses(inverses(belief.mean))[:, column] * factor
    sigma = euler_sigmas(belief)[:, column] * factor
    t, (mean, sigma) = with_gaps(t, mean, sigma)
    axes.fill_between(
        t, mean - 2 * sigma, mean + 2 * sigma, color=BELIEF, alpha=0.22, lw=0, label="belief ± 2σ"
    )
    axes.plot(t, mean, color=BELIEF, lw=1.3, label="belief", zorder=3)
    t, at = _by_time(clock, record.truth.stamp_ns)
    t, (true,) = with_gaps(t, euler_poses(record.truth.T_fs[at])[:, column] * factor)
    axes.plot(t, true, color=TRUTH, lw=1.2, label="truth", zorder=4)
    axes.set(ylabel=f"{what} [{unit}]")
    axes.set_ylim(*range_of(mean, true))


def _by_time(clock: _ContactClock, stamp_ns: Array) -> tuple[Array, Array]:
    """Seconds in contact, and the rows that they belong to."""
    t = clock(stamp_ns)
    at = np.flatnonzero(np.isfinite(t))
    return t[at], at


def with_gaps(t: Array, *values: Array, gap: float = 0.2) -> tuple[Array, list[Array]]:
    """The series with a NaN wherever time jumps by more than `gap`, so that lines do not bridge it."""
    jumps = np.flatnonzero(np.diff(t) > gap) + 1
    return np.insert(t, jumps, np.nan), [np.insert(value, jumps, np.nan) for value in values]


def range_of(*series: Array) -> tuple[float, float]:
    """Limits that hold nearly all of the series: the first moments of a contact may lie outside."""
    values = np.concatenate([value[np.isfinite(value)] for value in series])
    if len(values) == 0:
        return -1.0, 1.0
    low, high = np.percentile(values, [0.5, 99.5])
    margin = max(0.2 * (high - low), 0.3)
    return float(low - margin), float(high + margin)


# ---- twists ----


def twists(record: RunRecord) -> Figure:
    """Commanded twists and what the arm made of them, over the phases."""
    command, arm = record.command, record.arm_twist
    if len(command) == 0:
        return _message("no command was sent")
    figure, panels = plt.subplots(2, 1, figsize=(13, 7), sharex=True, layout="constrained")
    t0 = command.stamp_ns[0]
    seconds, arm_seconds = (command.stamp_ns - t0) * 1e-9, (arm.stamp_ns - t0) * 1e-9
    parts = ((0, 1e3, "linear velocity [mm/s]", "v"), (3, 180.0 / np.pi, "angular velocity [deg/s]", "ω"))
    for axes, (offset, factor, label, symbol) in zip(panels, parts, strict=True):
        used = _shade_phases(axes, record, t0)
        for k, color in enumerate(AXES):
            name = f"{symbol}{'xyz'[k]}"
            axes.plot(
                seconds, command.twist[:, offset + k] * factor, color=color, lw=1.4, label=f"{name} sent"
            )
            if len(arm):
                moved = arm.twist[:, offset + k] * factor
                axes.plot(arm_seconds, moved, color=color, lw=0.8, ls=":", label=f"{name} of the arm")
        axes.set(ylabel=label)
        lines = axes.legend(loc="upper left", ncols=3)
        axes.add_artist(lines)
        shades = [Patch(facecolor=PHASES[p], edgecolor="#bbbbbb", label=p) for p in PHASES if p in used]
        axes.legend(handles=shades, loc="upper right", ncols=3)
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 0.35 * (high - low))  # room for the legends
    panels[-1].set_xlabel("time since the first command [s]")
    figure.suptitle(f"{record.scene}: twist of the sensor, in the sensor frame", weight="bold")
    return figure


def _shade_phases(axes: Any, record: RunRecord, t0: int) -> set[str]:
    phase, stamps = record.command.phase, (record.command.stamp_ns - t0) * 1e-9
    change = np.flatnonzero(phase[1:] != phase[:-1]) + 1
    for first, end in zip(np.r_[0, change], np.r_[change, len(phase) - 1], strict=True):
        color = PHASES.get(str(phase[first]))
        if color is not None:
            axes.axvspan(stamps[first], stamps[end], color=color, lw=0, zorder=0)
    return set(phase.tolist())


# ---- latency ----


def latency(record: RunRecord) -> Figure:
    """How long after the exposure each stage has its output: distribution, and the medians one on another."""
    stages = {name: series.seconds * 1e3 for name, series in record.latency.items() if len(series)}
    if not stages:
        return _message("no latency was recorded")
    figure, (spread, stack) = plt.subplots(
        2, 1, figsize=(10, 6.5), sharex=True, height_ratios=[2.2, 1], layout="constrained"
    )
    for (name, values), color in zip(stages.items(), _colors(len(stages)), strict=True):
        ordered = np.sort(values)
        share = np.arange(1, len(ordered) + 1) / len(ordered)
        p50, p99 = np.percentile(ordered, [50, 99])
        spread.step(ordered, share, color=color, lw=2.0, label=f"{name}: p50 {p50:.1f}, p99 {p99:.1f} ms")
        spread.plot([p50, p99], [0.5, 0.99], "o", color=color, ms=4)
    right = _latency_axis(stages)
    _draw_latency_requirements(spread, right)
    spread.set(
        ylabel="part of the frames", ylim=(0.0, 1.02), title="time from exposure to each stage's output"
    )
    spread.legend(loc="center right", bbox_to_anchor=(0.88, 0.5))  # left of the last requirement
    _stack(stack, stages)
    stack.set_xlim(0.0, right)
    stack.set_xlabel("milliseconds after the exposure" + _beyond(stages, right))
    return figure


def _latency_axis(stages: dict[str, Array]) -> float:
    """Where the axis ends, ms: behind the requirements and the 99th percentiles; the tail may lie beyond."""
    p99 = max(float(np.percentile(values, 99)) for values in stages.values())
    return max(1.12 * max(LATENCY_REQUIREMENT.values()), 1.25 * p99)


def _draw_latency_requirements(axes: Any, right: float) -> None:
    """A line a requirement, its label on the side with room, one above the other so that none overlap."""
    for row, (name, limit) in enumerate(LATENCY_REQUIREMENT.items()):
        axes.axvline(limit, color=REFERENCE, ls="--", lw=1.2)
        text = f" {name} of {COMMAND_STAGE} \u2264 {limit:g} ms "
        side = "left" if limit < 0.5 * right else "right"
        axes.text(limit, 0.03 + 0.06 * row, text, color=REFERENCE, fontsize=9, ha=side)


def _beyond(stages: dict[str, Array], right: float) -> str:
    """How many frames of the last stage are later than the picture shows."""
    name, values = list(stages.items())[-1]
    late = values[values > right]
    if len(late) == 0:
        return ""
    return f" ({len(late)} of {len(values)} frames of the {name} lie beyond, the latest at {late.max():.0f})"


def _stack(axes: Any, stages: dict[str, Array]) -> None:
    """Two bars: what each stage adds to the median and to the 99th percentile."""
    for row, percentile in enumerate((50, 99)):
        start = 0.0
        for (name, values), color in zip(stages.items(), _colors(len(stages)), strict=True):
            end = float(np.percentile(values, percentile))
            if end > start:
                axes.barh(
                    row, end - start, left=start, color=color, height=0.6, label=name if row == 0 else None
                )
                start = end
    axes.set_yticks([0, 1], ["median", "p99"])
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    axes.legend(loc="center right")


def _colors(n: int) -> list[str]:
    return [STAGES[k % len(STAGES)] for k in range(n)]


def _message(text: str) -> Figure:
    """A picture that says why there is none."""
    figure = plt.figure(figsize=(8, 3))
    figure.text(0.5, 0.5, text, ha="center", va="center")
    return figure
