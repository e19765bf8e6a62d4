"""Pictures of estimates: predicted against actual, colored by precision; components over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator
from numpy.typing import NDArray

from tactile_perception.estimating.labels import COMPONENTS, NETWORK_UNITS
from tactile_perception.estimating.run import EstimateTable

Array = NDArray[np.float64]
Row = tuple[str, Array, Array, Array | None]
DPI = 110
_WELL = (
    "On the black line predicted is actual. Components of X_sf = X_fs\u207b\u00b9: rho_z is about minus the "
    "depth, rho_x and rho_y shear, phi_x and phi_y tilt, phi_z twist."
)
#: Leading digits of the ticks of a logarithmic axis, and how many ticks fit on one.
_DIGITS = ((1, 2, 3, 5, 7), (1, 2, 5), (1, 3), (1,))
_MOST_TICKS = 5


def draw_estimates(table: EstimateTable, path: Path, title: str) -> None:
    """The paper's figure: one row of plots for the network and, where there is one, one for the filter."""
    rows: list[Row] = [(name, table.labels, found.mean, found.sigma) for name, found in table.series.items()]
    draw_predicted_against_actual(path, rows, title, table.model.names, table.model.units)


def draw_predicted_against_actual(
    path: Path,
    rows: Sequence[Row],
    title: str,
    names: Sequence[str] = COMPONENTS,
    units: Sequence[str] = NETWORK_UNITS,
) -> None:
    """The paper's figure: predicted against actual, colored by precision, rows of three plots for each entry.

    A row is (name, actual (N, K), predicted (N, K), sigma (N, K) or None), of K components.
    """
    lines = -(-len(names) // 3)
    figure, grid = plot_grid(lines * len(rows), 3, 3.2)
    for axes_row, (name, actual, predicted, sigma) in zip(grid.reshape(len(rows), -1), rows, strict=True):
        for component, axes in enumerate(axes_row):
            if component >= len(names) or not np.isfinite(actual[:, component]).any():
                axes.set_axis_off()
                continue
            deviation, unit = None if sigma is None else sigma[:, component], units[component]
            _scatter(figure, axes, actual[:, component], predicted[:, component], deviation, unit)
            mae = np.nanmean(np.abs(predicted[:, component] - actual[:, component]))
            axes.set_title(f"{names[component]}: MAE {mae:.3g} {unit}")
            axes.set(xlabel=f"actual ({unit})", ylabel="predicted" if component % 3 else f"{name}\npredicted")
    figure.suptitle(title)
    if COMPONENTS[0] in names:
        figure.supxlabel(_WELL, fontsize=9, color="#555555")
    figure.savefig(path, dpi=DPI)


def plot_grid(rows: int, columns: int, height: float) -> tuple[Figure, Any]:
    """A figure and its axes (rows, columns); height of a row in inches."""
    figure = Figure(figsize=(3.3 * columns, height * rows + 0.3), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def log_axis(axes: Any, which: str) -> None:
    """Make the axis "x" or "y" logarithmic, with a few ticks in plain numbers; call it after plotting."""
    getattr(axes, f"set_{which}scale")("log")
    axis = getattr(axes, f"{which}axis")
    low, high = sorted(axis.get_view_interval())
    decades = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
    for digits in _DIGITS:
        ticks = np.outer(10.0**decades, digits).ravel()
        ticks = ticks[(ticks >= low) & (ticks <= high)]
        if len(ticks) <= _MOST_TICKS:
            break
    if len(ticks) < 2:  # less than a step of the finest
        ticks = np.array(MaxNLocator(_MOST_TICKS - 1).tick_values(low, high))
    axis.set_major_locator(FixedLocator(ticks.tolist()))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _short(value: float, _: object = None) -> str:
    """120k for 120000."""
    for factor, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= factor:
            return f"{value / factor:g}{letter}"
    return f"{value:g}"


def shared_legend(figure: Figure, axes: Any) -> None:
    """One legend below all plots, of the lines that these axes have."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=8)


def _scatter(
    figure: Figure, axes: Any, actual: Array, predicted: Array, sigma: Array | None, unit: str
) -> None:
    """One plot of the figure; without sigma in one color."""
    usable = np.flatnonzero(np.isfinite(predicted) & np.isfinite(actual))
    if sigma is None:
        axes.scatter(actual[usable], predicted[usable], s=3, color="tab:gray")
    else:
        # Precise points on top, as they are the ones to trust.
        order = usable[np.argsort(-sigma[usable])]
        precision = sigma[order] ** -2
        low, high = np.percentile(precision, [2.0, 98.0])
        range_shown = {"vmin": low, "vmax": max(high, low * 1.001)}
        points = axes.scatter(
            actual[order], predicted[order], c=precision, cmap="viridis", s=3, **range_shown
        )
        bar = figure.colorbar(points, ax=axes, label=f"precision (1/{unit}²)", pad=0.01)
        bar.formatter = FuncFormatter(_short)  # a power of ten over the bar would run into the title
    ends = [actual[usable].min(), actual[usable].max()]
    axes.plot(ends, ends, color="black", linewidth=0.8)


def draw_series(table: EstimateTable, path: Path, title: str) -> None:
    """Each component over time with its 2-sigma band."""
    figure = Figure(figsize=(12.0, 9.0), layout="constrained")
    seconds = np.array(table.stamps_ns) * 1e-9
    titles = table.model.titles
    for component, axes in enumerate(figure.subplots(len(titles), 1, sharex=True)):
        for name, values in table.series.items():
            mean, sigma = values.mean[:, component], values.sigma[:, component]
            (line,) = axes.plot(seconds, mean, linewidth=0.9, label=name)
            axes.fill_between(seconds, mean - 2 * sigma, mean + 2 * sigma, color=line.get_color(), alpha=0.2)
        axes.set_ylabel(titles[component])
        axes.grid(alpha=0.3)
    axes.set_xlabel("time (s)")
    axes.legend()
    figure.suptitle(title)
    figure.savefig(path, dpi=90)
