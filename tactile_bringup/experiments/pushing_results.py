"""What trials of pushing come to: the paper's tables with ours beside them, and maps of where it works."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base import html_page as html
from tactile_base.jobs import Row
from tactile_base.origin import origin
from tactile_base.whole_file import whole_file, write_csv
from tactile_bringup.experiments.pushing import Common, Map, Table, Trial, shown
from tactile_records.runs.page import origin_table
from tactile_sim.pushing_scene import SET

Array = NDArray[np.float64]

COLUMNS = (
    "object", "floor", "trials", "at the target", "mean [mm]", "deviation [mm]", "mean size [mm]",
    "largest [mm]", "paper's mean [mm]", "paper's deviation [mm]", "contact lost", "toppled", "time [s]",
)  # fmt: skip

LARGEST_ERROR = 20.0  # mm, where a map's colors end: the tip's radius, beyond which a target was passed
LUMA = (0.299, 0.587, 0.114)  # how bright red, green and blue look


@dataclass(frozen=True)
class Outcome:
    """What some trials have in common.

    Attributes
    ----------
    errors : ndarray
        Signed final target errors (mm) of those that came to the target.
    sets : ndarray
        Which set of trials, with one floor, each of these belongs to.
    seconds : ndarray
        How long these pushed.
    """

    trials: int
    errors: Array
    sets: Array
    seconds: Array
    lost: int
    toppled: int

    @classmethod
    def of(cls, rows: Sequence[Row]) -> Outcome:
        """Summarize the trials of some rows."""
        done = [row for row in rows if row["succeeded"]]
        return cls(
            len(rows),
            np.array([row["error_mm"] for row in done], dtype=float),
            np.array([row["trial"] // SET for row in done], dtype=float),
            np.array([row["work_s"] for row in done], dtype=float),
            sum(row["contact_lost"] for row in rows),
            sum(bool(row["toppled"]) for row in rows),
        )

    @property
    def success(self) -> float:
        """The part that came to the target; NaN without trials."""
        return len(self.errors) / self.trials if self.trials else np.nan

    @property
    def size(self) -> float:
        """Mean absolute error, mm."""
        return float(np.abs(self.errors).mean()) if len(self.errors) else np.nan

    @property
    def deviation(self) -> float:
        """Of the signed error (mm, of a sample) among trials of one set, as the paper's is."""
        _, which, counts = np.unique(self.sets, return_inverse=True, return_counts=True)
        freedom = len(self.errors) - len(counts)
        if freedom < 1:
            return np.nan
        means = np.bincount(which, self.errors) / counts
        return float(np.sqrt(((self.errors - means[which]) ** 2).sum() / freedom))

    def numbers(self) -> list[float]:
        """Mean and deviation of the signed error, mean and largest of its size, mm."""
        if not len(self.errors):
            return [np.nan] * 4
        return [float(self.errors.mean()), self.deviation, self.size, float(np.abs(self.errors).max())]


def table_rows(table: Table, rows: Sequence[Row]) -> list[list[Any]]:
    """One row for each object and floor that has trials, as `COLUMNS` says."""
    found = []
    for (name, floor), paper in table.paper.items():
        outcome = Outcome.of([row for row in rows if (row["object"], row["floor"]) == (name, floor)])
        if outcome.trials:
            counts = [outcome.trials, len(outcome.errors)]
            seconds = float(outcome.seconds.mean()) if len(outcome.seconds) else np.nan
            ends = [outcome.lost, outcome.toppled, seconds]
            found.append([name.replace("_", " "), floor, *counts, *outcome.numbers(), *paper, *ends])
    return found


def write_table(folder: Path, table: Table, rows: Sequence[Row], common: Common) -> list[Path]:
    """The table as a page, Markdown and CSV, and the trials as CSV; returns their paths."""
    lines, folder = table_rows(table, rows), Path(folder)
    paths = [folder / "table.md", folder / "table.csv", folder / "trials.csv"]
    with whole_file(paths[0]) as temporary:
        temporary.write_text(markdown(COLUMNS, lines))
    write_csv(paths[1], COLUMNS, lines)
    names = [name for name in rows[0] if name != "varied"] if rows else []
    write_csv(paths[2], names, ([row.get(name) for name in names] for row in rows))
    return [_page(folder, f"{table.title}: final target error", COLUMNS, lines, rows, common), *paths]


def _page(
    folder: Path,
    title: str,
    columns: Sequence[str],
    lines: Sequence[Sequence[Any]],
    rows: Sequence[Row],
    common: Common,
    pictures: Sequence[Path] = (),
) -> Path:
    """One file with the table, what did not go well, and how it was made."""
    numbers = [k for k, value in enumerate(lines[0]) if not isinstance(value, str)] if lines else []
    there = sum(bool(row["succeeded"]) for row in rows)
    content = [
        html.element("p", f"Simulated; {there} of {len(rows)} trials came to the target.", class_="quiet"),
        html.table(columns, [list(map(cell, line)) for line in lines], numbers),
        *(html.picture(path, title) for path in pictures),
    ]
    if failed := failures(rows):
        content += [html.element("h2", "What did not go well"), html.table([""], [[line] for line in failed])]
    settings = html.table(["", ""], list(dataclasses.asdict(common).items()))
    content += [html.element("h2", "Settings"), settings]
    content += [html.element("h2", "How it was made"), *origin_table(origin())]
    return html.write_page(folder / "report.html", title, *content)


def markdown(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table in Markdown; numbers with two decimals, NaN as nothing."""
    lines = [columns, ["---"] * len(columns), *([cell(value) for value in row] for row in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def cell(value: Any) -> str:
    """A value of a table in words."""
    if isinstance(value, float):
        return f"{value:.2f}" if np.isfinite(value) else ""
    return str(value)


def failures(rows: Sequence[Row]) -> list[str]:
    """A line for each trial that did not come to its target, lost a contact or toppled its object."""
    lines = []
    for row in rows:
        what = [] if row["succeeded"] else [row["reason"] or "failed"]
        what += ["the object toppled"] * bool(row["toppled"])
        what += ["contact was lost for a while"] * bool(row["contact_lost"] and row["succeeded"])
        if what:
            lines.append(f"{row['name']}: {'; '.join(what)}")
    return lines


# ---- maps ----


def write_map(folder: Path, chosen: Map, rows: Sequence[Row], trials: Sequence[Trial]) -> list[Path]:
    """Picture, page and table of a map; the table names one trial of each place where it breaks."""
    paths = [folder / f"{chosen.name}.png", folder / f"{chosen.name}.md"]
    by_name = {row["name"]: row for row in rows}
    places = [
        (varied, [by_name[t.name] for t in trials if t.varied == varied and t.name in by_name])
        for varied in dict.fromkeys(trial.varied for trial in trials)
    ]
    columns = [*chosen.variables, "trials", "at the target", "mean [mm]", "deviation [mm]", "mean size [mm]"]
    lines = []
    for varied, found in places:
        outcome = Outcome.of(found)
        broken = next(iter(failures(found)), "")
        counts = [outcome.trials, len(outcome.errors)]
        lines.append([*(shown(v) for _, v in varied), *counts, *outcome.numbers()[:3], broken])
    columns.append("a trial that shows how it breaks")
    with whole_file(paths[1]) as temporary:
        temporary.write_text(markdown(columns, lines))
    title = f"{chosen.name}: {chosen.object} on {chosen.floor}, controller {trials[0].common.controller}"
    outcomes = {varied: Outcome.of(found) for varied, found in places}
    title = title.replace("_", " ")
    _draw_map(paths[0], chosen, outcomes, title)
    return [_page(folder, title, columns, lines, rows, trials[0].common, paths[:1]), *paths]


def _draw_map(path: Path, chosen: Map, outcomes: dict[Any, Outcome], title: str) -> None:
    import matplotlib.pyplot as plt

    from tactile_records.runs.figures import style

    with style():
        figure, panels = plt.subplots(1, 2, figsize=(12, 4.6), layout="constrained")
        draw = _draw_lines if len(chosen.variables) == 1 else _draw_grid
        success = {varied: 100.0 * outcome.success for varied, outcome in outcomes.items()}
        size = {varied: outcome.size for varied, outcome in outcomes.items()}
        draw(panels[0], chosen, success, "at the target [%]", "RdYlGn", (0.0, 100.0))
        draw(panels[1], chosen, size, "mean size of the error [mm]", "viridis_r", (0.0, LARGEST_ERROR))
        figure.suptitle(title, weight="bold")
        figure.savefig(path)
        plt.close(figure)


def _draw_lines(
    axes: Any, chosen: Map, values: dict[Any, float], title: str, colors: str, limits: tuple[float, float]
) -> None:
    ((name, along),) = chosen.variables.items()
    axes.plot([shown(v) for v in along], [values.get(((name, v),), np.nan) for v in along], "o-")
    axes.set(title=title, xlabel=chosen.text(name), ylim=(limits[0], 1.05 * limits[1]))


def _draw_grid(
    axes: Any, chosen: Map, values: dict[Any, float], title: str, colors: str, limits: tuple[float, float]
) -> None:
    (first, along), (second, up) = chosen.variables.items()
    grid = np.array([[values.get(((first, a), (second, b)), np.nan) for a in along] for b in up])
    image = axes.imshow(grid, origin="lower", aspect="auto", cmap=colors, vmin=limits[0], vmax=limits[1])
    axes.set_xticks(range(len(along)), map(shown, along))
    axes.set_yticks(range(len(up)), map(shown, up))
    for (row, column), value in np.ndenumerate(grid):
        if np.isfinite(value):
            light = np.dot(image.cmap(image.norm(value))[:3], LUMA)
            ink = "black" if light > 0.5 else "white"
            axes.text(column, row, f"{value:.3g}", ha="center", va="center", fontsize=8, color=ink)
    axes.grid(visible=False)
    axes.set(title=title, xlabel=chosen.text(first), ylabel=chosen.text(second))
    axes.figure.colorbar(image, ax=axes)
