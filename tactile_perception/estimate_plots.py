"""Pictures of estimates: predicted against actual, colored by precision; components over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_perception.estimate_run import EstimateTable, Series
from tactile_perception.labels import COMPONENTS, NETWORK_UNITS

Array = NDArray[np.float64]


def draw_predicted_against_actual(table: EstimateTable, path: Path, title: str) -> None:
    """The paper's figure: one row of plots for the network and, where there is one, one for the filter."""
    rows = [("network", table.network)] + ([("with filter", table.filtered)] if table.has_filter else [])
    figure = Figure(figsize=(21.0, 3.6 * len(rows) + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes_grid = figure.subplots(len(rows), 6, squeeze=False)
    for axes_row, (name, series) in zip(axes_grid, rows, strict=True):
        error = table.mean_absolute_error(series)
        for component, axes in enumerate(axes_row):
            _scatter(figure, axes, table.labels[:, component], series, component)
            unit = NETWORK_UNITS[component]
            axes.set_title(f"{COMPONENTS[component]}, {name}: MAE {error[component]:.4g} {unit}", fontsize=10)
    figure.suptitle(title)
    figure.savefig(path, dpi=90)


def _scatter(figure: Figure, axes: Any, actual: Array, series: Series, component: int) -> None:
    predicted, sigma = series.mean[:, component], series.sigma[:, component]
    usable = np.isfinite(predicted) & np.isfinite(actual)
    # Precise points on top, as they are the ones to trust.
    order = np.flatnonzero(usable)[np.argsort(-sigma[usable])]
    precision = sigma[order] ** -2
    low, high = np.percentile(precision, [2.0, 98.0])
    points = axes.scatter(
        actual[order], predicted[order], c=precision, cmap="jet", s=4, vmin=low, vmax=max(high, low * 1.001)
    )
    figure.colorbar(points, ax=axes, label="precision", pad=0.01)
    limits = [actual[order].min(), actual[order].max()]
    axes.plot(limits, limits, color="black", linewidth=0.8)
    axes.set(xlabel=f"actual ({NETWORK_UNITS[component]})", ylabel="predicted")


def draw_series(table: EstimateTable, path: Path, title: str) -> None:
    """Each component over time with its 2-sigma band."""
    figure = Figure(figsize=(12.0, 9.0), layout="constrained")
    FigureCanvasAgg(figure)
    seconds = np.array(table.stamps_ns) * 1e-9
    for component, axes in enumerate(figure.subplots(6, 1, sharex=True)):
        series = [("network", table.network)] + (
            [("with filter", table.filtered)] if table.has_filter else []
        )
        for name, values in series:
            mean, sigma = values.mean[:, component], values.sigma[:, component]
            (line,) = axes.plot(seconds, mean, linewidth=0.9, label=name)
            axes.fill_between(seconds, mean - 2 * sigma, mean + 2 * sigma, color=line.get_color(), alpha=0.2)
        axes.set_ylabel(f"{COMPONENTS[component]} ({NETWORK_UNITS[component]})")
        axes.grid(alpha=0.3)
    axes.set_xlabel("time (s)")
    axes.legend()
    figure.suptitle(title)
    figure.savefig(path, dpi=90)
