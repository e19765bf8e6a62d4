"""Table and picture of the dial."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tactile_perception.evaluation.reference import paper_tables

if TYPE_CHECKING:
    from dial import Row

_MARKERS = {"fp32": "o", "int8": "s"}


def error_ratio(mae: Sequence[float]) -> float:
    """Geometric mean, over the components, of the errors as multiples of the paper's GDN's."""
    paper = paper_tables().networks["GDN"][1]
    return float(np.exp(np.log(np.array(mae) / paper).mean()))


def markdown_table(rows: Sequence[Row]) -> str:
    """The table as it stands in docs/perception.md."""
    head = (
        "| network | arithmetic | MB | network ms | estimate ms p50 / p99 | CPU p99 | at 60 Hz | two threads "
        "| rho_x, rho_y, rho_z (mm) | phi_x, phi_y, phi_z (rad) | / paper | NEES / 6 | 95 % covers |"
    )
    lines = [head, "| " + " | ".join(["---"] * 13) + " |"]
    for row in rows:
        lines.append(
            f"| {row.name} | {row.arithmetic} | {row.megabytes:.2f} | {row.network_p50:.2f} "
            f"| {row.p50:.2f} / {row.p99:.2f} | {row.cpu_p99:.2f} "
            f"| {row.paced_p50:.2f} / {row.paced_p99:.2f} "
            f"| {row.p50_two_threads:.2f} / {row.p99_two_threads:.2f} "
            f"| {', '.join(f'{value:.3f}' for value in row.mae[:3])} "
            f"| {', '.join(f'{value:.4f}' for value in row.mae[3:])} | {error_ratio(row.mae):.3f} "
            f"| {row.nees:.2f} | {row.coverage95[0] * 100:.0f} to {row.coverage95[1] * 100:.0f} % |"
        )
    return "\n".join(lines)


def draw_pareto(rows: Sequence[Row], path: Path, title: str) -> None:
    """Error against time; the line joins what nothing beats in both."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    times = np.array([row.p50 for row in rows])
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
    axes.set(xscale="log", xlabel="median time of an estimate on one core (ms), pre-processing included")
    axes.set(ylabel="mean absolute error / the paper's (geometric mean)", title=title)
    axes.grid(alpha=0.3, which="both")
    figure.savefig(path, dpi=110)
