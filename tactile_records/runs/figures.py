"""Pictures that all tasks share, from a `RunRecord`: contact against the truth, twists, latency.

One colour for one thing in all of them: the truth is black, estimates are orange dots, beliefs blue with a
band of two standard deviations, the reference green. Needs matplotlib; draws without a display.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from tactile_records.runs.euler_poses import component, euler_poses, euler_sigmas, inverses
from tactile_records.runs.metrics import COMMAND_STAGE
from tactile_records.runs.record import RunRecord

Array = NDArray[Any]

TRUTH, ESTIMATE, BELIEF, REFERENCE, SURFACE = "#1a1a1a", "#f0a050", "#1f6fb4", "#2e9e4f", "#d9d2c5"
AXES = ("#c8443c", "#3f9c4a", "#3a6fc0")  # x, y, z, as RViz draws them
PHASES = {
    "go_to_start": "#e6e6f2",
    "touch": "#fdf7e3",
    "lift": "#fdf7e3",
    "approach": "#fdf0c9",
    "settle": "#dff0e0",
    "follow": "#ffffff",
    "track": "#ffffff",
    "push": "#ffffff",
    "move": "#ffffff",
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
#: The look of all pictures.
style = functools.partial(plt.rc_context, STYLE)
LATENCY_REQUIREMENT = {"p50": 8.0, "p99": 25.0}  # ms


#: Draws an arm's picture, or None where the run has nothing of the kind.
Picture = Callable[[RunRecord, Mapping[str, RunRecord]], Figure | None]


def draw_all(
    pictures: Mapping[str, Picture], run: Mapping[str, RunRecord], arm: str, folder: Path
) -> list[Path]:
    """Draw one arm's pictures of a run into files of these names; returns the paths of those there are."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, draw in pictures.items():
        with style():
            figure = draw(run[arm], run)
            if figure is not None:
                figure.savefig(folder / name)
                plt.close(figure)
                paths.append(folder / name)
    return paths


def of_one_arm(draw: Callable[[RunRecord], Figure | None]) -> Picture:
    """A picture for which the other arms do not matter."""
    return lambda record, run: draw(record)


def caption(figure: Figure, text: str) -> None:
    """Say below a picture what it shows when all is well."""
    figure.supxlabel(text, fontsize=9, color="#555555")


def reference_of(record: RunRecord) -> Array:
    """The reference contact pose (6,) at the end of the run; NaN where there was none."""
    known = np.isfinite(record.command.reference).all(axis=1)
    return np.asarray(record.command.reference[known][-1]) if known.any() else np.full(6, np.nan)


# ---- contact ----


def contact(record: RunRecord) -> Figure:
    """Depth, shear and angles: truth, estimates, beliefs with two standard deviations, while in contact."""
    clock = _ContactClock(record)
    if not clock.stretches:
        return message("the run did not come to settling: there is no contact to show")
    figure, panels = plt.subplots(3, 2, figsize=(13, 9), sharex=True, layout="constrained")
    rows = (("z", "x"), ("alpha", "y"), ("beta", "gamma"))
    for line, names in zip(panels, rows, strict=True):
        for axes, name in zip(line, names, strict=True):
            _draw_component(axes, record, clock, name)
    panels[0, 0].legend(loc="lower right", ncols=2)
    for axes in panels[-1]:
        axes.set_xlabel(
            "time in contact [s]" + (", goals one after the other" if len(record.goals) > 1 else "")
        )
    figure.suptitle(f"{record.scene}: contact pose, settling (shaded), then {record.work}", weight="bold")
    caption(
        figure,
        "When all is well, depth and angles keep to the green line, and the truth to the blue band; shear "
        "is the least certain.",
    )
    return figure


class _ContactClock:
    """Time that runs only while settling or following: the paths one after the other, with small gaps."""

    GAP = 0.5  # s

    def __init__(self, record: RunRecord) -> None:
        stamps, phases, paths = record.command.stamp_ns, record.command.phase, record.command.goal
        self.stretches: list[tuple[int, int, float, str, int]] = []  # from, to (ns), begin (s), phase, path
        begin, last_path = 0.0, None
        change = np.flatnonzero((phases[1:] != phases[:-1]) | (paths[1:] != paths[:-1])) + 1
        for first, end in zip(np.r_[0, change], np.r_[change, len(phases)], strict=True):
            if end <= first or phases[first] not in ("settle", record.work):
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
    column, factor, label = component(name)
    for first, stop, begin, phase, _ in clock.stretches:
        if phase == "settle":
            axes.axvspan(begin, begin + (stop - first) * 1e-9, color=PHASES["settle"], lw=0, zorder=0)
    if name in ("z", "alpha", "beta"):
        axes.axhline(
            reference_of(record)[column] * factor, color=REFERENCE, ls="--", lw=1.2, label="reference"
        )
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
    axes.set(ylabel=label)
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
        return message("no command was sent")
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
    caption(
        figure, "When all is well, what the arm does (dotted) lies on what it was sent, and both end at zero."
    )
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


def latency(record: RunRecord) -> Figure | None:
    """How long after the exposure each stage has its output: distribution, and the medians one on another.

    Of the exposures in the task's own phase, as the report has it; of all where there was none. None of a
    run in one process, where latency is a setting.
    """
    series = record.latency
    if record.source == "offline":
        return None
    worked = any(record.working(stage.stamp_ns).any() for stage in series.values())
    stages = {
        name: 1e3 * (stage.seconds[record.working(stage.stamp_ns)] if worked else stage.seconds)
        for name, stage in series.items()
    }
    stages = {name: values for name, values in stages.items() if len(values)}
    if not stages:
        return message("no latency was recorded")
    figure, (spread, stack) = plt.subplots(
        2, 1, figsize=(10, 6.5), sharex=True, height_ratios=[2.2, 1], layout="constrained"
    )
    for (name, values), color in zip(stages.items(), itertools.cycle(STAGES), strict=False):
        ordered = np.sort(values)
        share = np.arange(1, len(ordered) + 1) / len(ordered)
        p50, p99 = np.percentile(ordered, [50, 99])
        spread.step(ordered, share, color=color, lw=2.0, label=f"{name}: p50 {p50:.1f}, p99 {p99:.1f} ms")
        spread.plot([p50, p99], [0.5, 0.99], "o", color=color, ms=4)
    right = _latency_axis(stages)
    _draw_latency_requirements(spread, right)
    spread.set(
        ylabel="part of the frames",
        ylim=(0.0, 1.02),
        title=f"time from exposure to each stage's output, {record.work if worked else 'all phases'}",
    )
    spread.legend(loc="center right", bbox_to_anchor=(0.88, 0.5))  # left of the last requirement
    _stack(stack, stages)
    stack.set_xlim(0.0, right)
    stack.set_xlabel("milliseconds after the exposure" + _beyond(stages, right))
    caption(
        figure,
        f"When all is well, the line of the {COMMAND_STAGE} passes 0.5 left of the first green line and 0.99 "
        "left of the second.",
    )
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
        for (name, values), color in zip(stages.items(), itertools.cycle(STAGES), strict=False):
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


def message(text: str) -> Figure:
    """A picture that says why there is none."""
    figure = plt.figure(figsize=(8, 3))
    figure.text(0.5, 0.5, text, ha="center", va="center")
    return figure


def force(record: RunRecord) -> Figure | None:
    """The force on the sensor: estimates, and beliefs with two standard deviations; None without any."""
    clock = _ContactClock(record)
    if not len(record.force) or not clock.stretches:
        return None
    figure, grid = plt.subplots(3, 1, figsize=(9.0, 6.0), sharex=True, layout="constrained")
    for k, (axes, axis) in enumerate(zip(grid, "xyz", strict=True)):
        t, at = _by_time(clock, record.force_estimate.stamp_ns)
        estimates = record.force_estimate.force[at, k]
        axes.plot(t, estimates, ".", color=ESTIMATE, ms=2.0, alpha=0.6, label="estimate", zorder=2)
        t, at = _by_time(clock, record.force.stamp_ns)
        values, sigma = record.force.force[at, k], np.sqrt(record.force.cov[at, k, k])
        t, (values, sigma) = with_gaps(t, values, sigma)
        axes.fill_between(
            t, values - 2 * sigma, values + 2 * sigma, color=BELIEF, alpha=0.22, lw=0, label="belief ± 2σ"
        )
        axes.plot(t, values, color=BELIEF, lw=1.3, label="belief", zorder=3)
        axes.set(ylabel=f"force {axis} (N)")
    grid[-1].set_xlabel("time in contact (s)")
    grid[0].legend(loc="upper right", ncols=3)
    return figure


CONTACT_PICTURES: dict[str, Picture] = {
    "contact.png": of_one_arm(contact),
    "force.png": of_one_arm(force),
    "twists.png": of_one_arm(twists),
    "latency.png": of_one_arm(latency),
}
