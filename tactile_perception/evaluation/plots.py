"""Figures of an evaluation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from tactile_perception.estimating.plots import (
    DPI,
    Row,
    draw_predicted_against_actual,
    log_axis,
    plot_grid,
    shared_legend,
)
from tactile_perception.evaluation.evaluate import Assessment, EvaluationData, ModelResult
from tactile_perception.evaluation.metrics import CURVE, shear_of
from tactile_perception.evaluation.report import groups

#: Cells with fewer samples stay empty.
_FEWEST = 5


def draw_all(out: Path, data: EvaluationData, results: Sequence[ModelResult]) -> list[Path]:
    """Every figure that the results allow, as PNG files in the folder `out`."""
    shown = [best(members) for members in groups(results).values()]
    rows: list[Row] = []
    for result in shown:
        predictions = result.best.predictions
        sigma = None if predictions.cov is None else predictions.sigma
        rows.append((result.name, data.targets, predictions.mean, sigma))
    paths = [out / f"{name}.png" for name in ("predicted_against_actual", "error_by_depth_and_shear", "slip")]
    titles = results[0].names, results[0].units
    draw_predicted_against_actual(paths[0], rows, f"{data.folder.name}, {len(data)} images", *titles)
    draw_by_depth_and_shear(paths[1], shown)
    draw_slip(paths[2], data, shown)
    uncertain = [result for result in shown if result.raw.consistency is not None]
    if uncertain:
        paths += [out / "reliability.png", out / "error_by_sigma.png"]
        draw_reliability(paths[3], uncertain)
        draw_error_by_sigma(paths[4], uncertain)
    return paths


def best(members: Sequence[ModelResult]) -> ModelResult:
    """The model with the lowest loss, as the paper's figures show it."""

    def loss(result: ModelResult) -> float:
        consistency = result.raw.consistency
        return result.accuracy.mse if consistency is None else consistency.nll

    return min(members, key=loss)


def _states(results: Sequence[ModelResult]) -> Iterator[tuple[Assessment, str, dict[str, str]]]:
    """Assessment, line style, color and label of each uncertain model, as it is and calibrated."""
    for number, result in enumerate(results):
        states = (result.raw, ":", "as the network says"), (result.calibrated, "-", "calibrated")
        for assessment, style, state in states:
            if assessment is not None and assessment.consistency is not None:
                yield assessment, style, {"color": f"C{number}", "label": f"{result.name}, {state}"}


def _save(figure: Figure, grid: Any, path: Path, ylabel: str) -> None:
    """With this label on each row of plots, and one legend for all."""
    for axes_row in grid:
        axes_row[0].set_ylabel(ylabel)
    shared_legend(figure, grid[0][0])
    figure.savefig(path, dpi=DPI)


def draw_reliability(path: Path, results: Sequence[ModelResult]) -> None:
    """Coverage against the nominal level of central intervals, before and after calibration."""
    figure, grid = plot_grid(1, len(results[0].names), 4.3)
    for component, axes in enumerate(grid[0]):
        axes.plot([0.0, 1.0], [0.0, 1.0], color="black", linewidth=0.8)
        for assessment, style, look in _states(results):
            assert assessment.consistency is not None
            axes.plot(CURVE, assessment.consistency.curve[:, component], style, **look)
        axes.set(xlabel="nominal", title=results[0].names[component], aspect="equal")
        axes.grid(alpha=0.3)
    _save(figure, grid, path, "fraction of labels inside")


def draw_error_by_sigma(path: Path, results: Sequence[ModelResult]) -> None:
    """Root mean square error against predicted sigma in ten bins of as many samples each."""
    figure, grid = plot_grid(1, len(results[0].names), 4.3)
    for component, axes in enumerate(grid[0]):
        reach = []
        for assessment, style, look in _states(results):
            assert assessment.by_sigma is not None
            bins = assessment.by_sigma[component]
            sigma, rmse = bins.sigma[:, component], bins.rmse[:, component]
            axes.plot(sigma, rmse, f"o{style}", markersize=3, **look)
            reach += [*sigma[np.isfinite(sigma)], *rmse[np.isfinite(rmse)]]
        limits = [min(reach), max(reach)]
        axes.plot(limits, limits, color="black", linewidth=0.8)
        first = results[0]
        axes.set(xlabel=f"predicted sigma ({first.units[component]})", title=first.names[component])
        log_axis(axes, "x")
        log_axis(axes, "y")
        axes.grid(alpha=0.3)
    _save(figure, grid, path, "root mean square error")


def draw_by_depth_and_shear(path: Path, results: Sequence[ModelResult]) -> None:
    """Mean absolute error by depth and by tangential displacement, with the mean predicted sigma dashed."""
    figure, grid = plot_grid(2, len(results[0].names), 3.0)
    for axes_row, which in zip(grid, ("by_depth", "by_shear"), strict=True):
        for component, axes in enumerate(axes_row):
            for color, result in enumerate(results):
                bins = getattr(result.best, which)
                middle = 0.5 * (bins.edges[1:] + bins.edges[:-1])
                axes.plot(middle, bins.mae[:, component], "o-", color=f"C{color}", label=result.name)
                if np.isfinite(bins.sigma).any():
                    # A Gaussian's mean absolute error is 0.798 of its sigma.
                    expected = np.sqrt(2.0 / np.pi) * bins.sigma[:, component]
                    axes.plot(middle, expected, "--", color=f"C{color}", label=f"{result.name}, predicted")
            axes.set(xlabel=f"{which[3:]} (mm)", title=results[0].titles[component])
            axes.set_ylim(bottom=0.0)
            axes.grid(alpha=0.3)
    _save(figure, grid, path, "mean absolute error")


def draw_slip(path: Path, data: EvaluationData, results: Sequence[ModelResult]) -> None:
    """Mean absolute error over depth and tangential displacement: it shows where the tip slips."""
    depth, shear = data.euler_mm_deg[:, 2], shear_of(data.euler_mm_deg)
    # from zero to the largest there is, and a micrometer where there is none
    edges = (np.linspace(0.0, max(depth.max(), 1e-3), 9), np.linspace(0.0, max(shear.max(), 1e-3), 9))
    count = np.histogram2d(depth, shear, edges)[0]
    figure, grid = plot_grid(len(results), len(results[0].names), 3.2)
    for axes_row, result in zip(grid, results, strict=True):
        error = np.abs(result.raw.predictions.mean - data.targets)
        for component, axes in enumerate(axes_row):
            total = np.histogram2d(depth, shear, edges, weights=error[:, component])[0]
            mean = np.where(count >= _FEWEST, total / np.maximum(count, 1.0), np.nan)
            picture = axes.pcolormesh(edges[1], edges[0], mean, cmap="viridis", vmin=0.0)
            figure.colorbar(picture, ax=axes, pad=0.01)
            axes.set_title(results[0].titles[component])
            axes.set(xlabel="shear (mm)", ylabel="depth (mm)" if component else f"{result.name}\ndepth (mm)")
    figure.suptitle("mean absolute error")
    figure.savefig(path, dpi=DPI)
