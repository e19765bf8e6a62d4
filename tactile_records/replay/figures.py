"""Picture that compares replayed runs of one arm: depth, angles, shear and NIS, with bands of two sigma."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from tactile_records.replay.report import RunResult
from tactile_records.replay.track import ArmInputs
from tactile_records.runs.euler_poses import component, euler_poses, euler_sigmas, inverses
from tactile_records.runs.figures import BELIEF, ESTIMATE, TRUTH, range_of, style, with_gaps

Array = NDArray[Any]

PANELS = ("z", "gamma", "x", "y", "alpha", "beta")
GAP = 0.3  # s; a longer time without contact is drawn as this
MOST_POINTS = 2000  # a line
LEGEND_COLUMNS = 3
BANDS = 3  # more runs than this are drawn without bands
_WELL = (
    "Band, or dashed: two standard deviations about the run of that color. When all is well, the truth stays "
    "within, and NIS / 6 is not above 1; far below it the estimates are better than they say."
)


def compare(arm: ArmInputs, results: Sequence[RunResult], title: str, path: Path) -> None:
    """Draw the runs of one arm into a PNG."""
    axis = _Axis(arm)
    with style():
        figure, panels = plt.subplots(4, 2, figsize=(13, 11), sharex=True)
        colors = _colors(results)
        for axes, name in zip(panels.flat, PANELS, strict=False):
            _draw_component(axes, arm, results, colors, axis, name)
        _draw_nis(panels[3, 0], results, colors, axis)
        _draw_sigma(panels[3, 1], results, colors, axis)
        for axes in panels[-1]:
            axes.set_xlabel("time in contact [s], pauses shortened")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        lines = -(-len(labels) // LEGEND_COLUMNS)
        figure.legend(
            handles,
            labels,
            loc="lower center",
            bbox_to_anchor=(0.5, 0.025),
            ncols=min(LEGEND_COLUMNS, len(labels)),
        )
        # margins that fit: the layout engine of matplotlib would find them in half a second
        figure.subplots_adjust(0.06, 0.095 + 0.018 * lines, 0.985, 0.955, wspace=0.15, hspace=0.1)
        figure.text(0.5, 0.012, _WELL, ha="center", fontsize=9, color="#555555")
        figure.suptitle(title, weight="bold")
        figure.savefig(path)
        plt.close(figure)


class _Axis:
    """Seconds in contact of each exposure, pauses shortened."""

    def __init__(self, arm: ArmInputs) -> None:
        stamps = np.array([m.stamp_ns for m in arm.measurements if m.estimate is not None], np.int64)
        steps = np.diff(stamps) * 1e-9
        steps[(steps > GAP) | (steps < 0.0)] = GAP
        seconds = np.concatenate([np.zeros(min(1, len(stamps))), np.cumsum(steps)])
        self.stamps, first = np.unique(stamps, return_index=True)  # of one that comes twice the first time
        self.seconds = seconds[first]
        length = float(seconds[-1]) if len(seconds) else 0.0
        self.gap = max(0.9 * GAP, 3.0 * length / MOST_POINTS)  # s between points that are not joined

    def rows(self, stamps: Array) -> tuple[Array, Array]:
        """Rows of the stamps that are of an exposure in contact, at most `MOST_POINTS`, and their seconds."""
        _, mine, at = np.intersect1d(stamps, self.stamps, return_indices=True)
        order = np.argsort(self.seconds[at], kind="stable")
        order = order[:: max(1, -(-len(order) // MOST_POINTS))]
        return mine[order], self.seconds[at][order]


def _colors(results: Sequence[RunResult]) -> list[Any]:
    """One colour for a run; what is smoothed has that of its run."""
    count = sum(not result.smoothed for result in results)
    colors = (
        [plt.colormaps["viridis"](0.9 * k / (count - 1)) for k in range(count)] if count > 1 else [BELIEF]
    )
    number = np.cumsum([not result.smoothed for result in results]) - 1
    return [colors[k] for k in number]


def _dashes(result: RunResult) -> str:
    return ":" if result.smoothed else "-"


def _draw_component(
    axes: Any, arm: ArmInputs, results: Sequence[RunResult], colors: list[Any], axis: _Axis, name: str
) -> None:
    column, factor, label = component(name)
    drawn = [np.zeros(0)]
    touching = [m for m in arm.measurements if m.estimate is not None]
    if touching:
        rows, t = axis.rows(np.array([m.stamp_ns for m in touching]))
        means = np.array([touching[row].estimate.mean for row in rows])
        values = euler_poses(inverses(means))[:, column] * factor
        axes.plot(t, values, ".", color=ESTIMATE, ms=2.0, alpha=0.6, label="estimate", zorder=2)
    for result, color in zip(results, colors, strict=True):
        rows, t = axis.rows(result.beliefs.stamp_ns)
        if not len(rows):
            continue
        beliefs = result.beliefs.rows(rows)
        mean = euler_poses(inverses(beliefs.mean))[:, column] * factor
        if len(results) <= BANDS:
            sigma = 2.0 * euler_sigmas(beliefs)[:, column] * factor
            _draw_band(axes, with_gaps(t, mean - sigma, mean + sigma, gap=axis.gap), color, len(results) == 1)
        gt, (line,) = with_gaps(t, mean, gap=axis.gap)
        axes.plot(gt, line, color=color, lw=1.2, ls=_dashes(result), label=result.name, zorder=3)
        drawn.append(mean)
    rows, t = axis.rows(arm.truth.stamp_ns)
    if len(rows):
        true = euler_poses(arm.truth.T_fs[rows])[:, column] * factor
        gt, (line,) = with_gaps(t, true, gap=axis.gap)
        axes.plot(gt, line, color=TRUTH, lw=1.0, label="truth", zorder=4)
        drawn.append(true)
    axes.set(ylabel=label)
    axes.set_ylim(*range_of(*drawn))


def _draw_band(axes: Any, series: tuple[Array, list[Array]], color: Any, filled: bool) -> None:
    """Two standard deviations about a line: an area, or its edges where areas would cover each other."""
    t, (low, high) = series
    if filled:
        axes.fill_between(t, low, high, color=color, alpha=0.18, lw=0, label="\u00b1 2\u03c3")
    else:
        for edge in (low, high):
            axes.plot(t, edge, color=color, lw=0.6, ls=(0, (4, 2)), alpha=0.8)


def _draw_nis(axes: Any, results: Sequence[RunResult], colors: list[Any], axis: _Axis) -> None:
    """NIS over its degrees of freedom, averaged over half a second."""
    for result, color in zip(results, colors, strict=True):
        known = result.beliefs.rows(result.beliefs.nis_dof > 0)
        if result.smoothed or not len(known):
            continue
        rows, t = axis.rows(known.stamp_ns)
        values = known.nis[rows] / known.nis_dof[rows]
        width = max(1, round(0.5 / max(float(np.median(np.diff(t))), 1e-3))) if len(t) > 2 else 1
        smooth = np.convolve(values, np.ones(width) / width, mode="same") if len(values) >= width else values
        axes.plot(*_flat(with_gaps(t, smooth, gap=axis.gap)), color=color, lw=1.0)
    axes.axhline(1.0, color=TRUTH, lw=0.8, ls="--")
    axes.set(ylabel="NIS / 6, over 0.5 s", yscale="log")


def _draw_sigma(axes: Any, results: Sequence[RunResult], colors: list[Any], axis: _Axis) -> None:
    column, factor, label = component("z")
    for result, color in zip(results, colors, strict=True):
        rows, t = axis.rows(result.beliefs.stamp_ns)
        if len(rows):
            sigma = euler_sigmas(result.beliefs.rows(rows))[:, column] * factor
            axes.plot(*_flat(with_gaps(t, sigma, gap=axis.gap)), color=color, lw=1.0, ls=_dashes(result))
    axes.set(ylabel=f"σ of {label}", yscale="log")


def _flat(series: tuple[Array, list[Array]]) -> tuple[Array, Array]:
    return series[0], series[1][0]
