"""Table and picture of the dial."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tactile_perception.evaluation.report import paper_tables

if TYPE_CHECKING:
    from dial import Row

_MARKERS = {"fp32": "o", "int8": "s"}


def error_ratio(mae: Sequence[float]) -> float:
    """Geometric mean, over the components, of the errors as multiples of the paper's GDN's."""
    paper = paper_tables().networks["GDN"][1]
    return float(np.exp(np.log(np.array(mae) / paper).mean()))


def markdown_table(rows: Sequence[Row]) -> str:
    """The table of docs/results/perception.md; without errors for networks that were not trained."""
    columns = {
        "network": [row.name for row in rows],
        "": [row.arithmetic for row in rows],
        "MB": [f"{row.megabytes:.2f}" for row in rows],
        "estimate: CPU p50 / p99 (ms)": [f"{row.cpu_p50:.2f} / {row.cpu_p99:.2f}" for row in rows],
        "network p50": [f"{row.network_p50:.2f}" for row in rows],
        "at 60 Hz": [f"{row.paced_p50:.2f}" for row in rows],
        "two threads": [f"{row.p50_two_threads:.2f}" for row in rows],
    }
    if not any(np.isnan(row.nees) for row in rows):
        columns |= {
            "rho_x, rho_y, rho_z (mm)": [", ".join(f"{value:.3f}" for value in row.mae[:3]) for row in rows],
            "phi_x, phi_y, phi_z (rad)": [", ".join(f"{value:.4f}" for value in row.mae[3:]) for row in rows],
            "/ paper": [f"{error_ratio(row.mae):.2f}" for row in rows],
            "NEES / 6": [f"{row.nees:.2f}" for row in rows],
            "95 % covers": ["{:.0f} to {:.0f} %".format(*(100 * c for c in row.coverage95)) for row in rows],
        }
    lines = [list(columns), ["---"] * len(columns), *zip(*columns.values(), strict=True)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def draw_pareto(rows: Sequence[Row], path: Path, title: str) -> None:
    """Error against time; the line joins what nothing beats in both."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from tactile_perception.estimating.plots import log_axis

    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    times = np.array([row.cpu_p50 for row in rows])
    errors = np.array([error_ratio(row.mae) for row in rows])
    names = list(dict.fromkeys(row.name for row in rows))
    for row, time, error in zip(rows, times, errors, strict=True):
        color = f"C{names.index(row.name) % 10}"
        filled = color if row.arithmetic == "int8" else "none"
        axes.plot(time, error, _MARKERS[row.arithmetic], color=color, markerfacecolor=filled, markersize=8)
        axes.annotate(
            f"{row.name} {row.arithmetic}", (time, error), xytext=(6, 4), textcoords="offset points",
            fontsize=8,
        )  # fmt: skip
    best = [i for i in np.argsort(times) if errors[i] <= errors[times <= times[i]].min()]
    axes.plot(times[best], errors[best], "-", color="0.6", zorder=0)
    axes.margins(x=0.2, y=0.08)
    log_axis(axes, "x")
    axes.set(xlabel="median CPU time of an estimate (ms), pre-processing included")
    axes.set(ylabel="mean absolute error / the paper's (geometric mean)", title=title)
    axes.grid(alpha=0.3, which="both")
    figure.savefig(path, dpi=110)
