"""Constant offsets that explain the paper's errors of pushing: fitted to the means of its tables.

An arm's sensor is turned, or shifted, in its tool, and nobody knows: by as much in all rows of a table, since
one cell made them. Nothing else is off: no place, angle or centre of friction is drawn; fidelity plane::

    tables, names = CELLS["one arm"]
    fit = fit_offsets(Rows(tables, names, run))
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from tactile_base.jobs import Row
from tactile_bringup.experiments.pushing import PLANE, Common, Trial, table_of
from tactile_bringup.experiments.pushing_results import Outcome
from tactile_bringup.experiments.pushing_variations import VARIABLES

Array = NDArray[np.float64]
Place = tuple[float, ...]

#: Cells by their tables: what may be displaced in each (`pushing_variations.VARIABLES`).
CELLS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "one arm": (("single",), ("contact_angle", "contact_offset")),
    "two arms": (
        ("dual", "tall"),
        ("contact_angle", "contact_offset", "follower_angle", "follower_offset"),
    ),
}
NOTHING_DRAWN = ("center_of_friction", 0.0), ("placement", 0.0), ("placement_angle", 0.0)
STEP = 0.5  # deg or mm, for differences
ORDINARY = 3.0  # deg or mm: an offset of this counts as an error of 1 mm, so that none of two alike runs away
LARGEST = 8.0  # deg or mm
MISSED = 20.0  # mm, for a row of which offsets keep all pushes from their target
MOST = 8  # steps of the fit
TAIL = 1.5  # mm: an error beyond it pulls less than by its square


@dataclass(frozen=True)
class Fit:
    """What offsets come to.

    Attributes
    ----------
    offsets : variable -> value, deg or mm
    deviations : of each, by how the rows miss their means
    rows : (table, object, floor) of each row
    paper : ndarray (R, 2) mean and deviation, mm
    before, after : ndarray (R,)
        Means without and with the offsets, mm; NaN where no push comes to its target, which is not fitted to.
    """

    offsets: dict[str, float]
    deviations: dict[str, float]
    rows: list[tuple[str, str, str]]
    paper: Array
    before: Array
    after: Array

    def words(self) -> list[str]:
        """What was found, in sentences."""
        found = (
            f"{VARIABLES[name].text}: {value:.2f} +- {self.deviations[name]:.2f}"
            for name, value in self.offsets.items()
        )
        ends = (
            f"{how}: {self.missed(means):.2f} mm RMS from the paper's means, "
            f"{self.within(means)} of {np.isfinite(means).sum()} within its deviation"
            for how, means in (("without", self.before), ("with", self.after))
        )
        return [*found, *ends]

    def missed(self, means: Array) -> float:
        """RMS by which means miss the paper's, mm."""
        return float(np.sqrt(np.nanmean((means - self.paper[:, 0]) ** 2)))

    def within(self, means: Array) -> int:
        """How many of the means lie within the paper's deviation."""
        return int((np.abs(means - self.paper[:, 0]) <= self.paper[:, 1]).sum())


class Rows:
    """The rows of some tables, run at places: values of `names`.

    Parameters
    ----------
    run : runs trials, `Row` by `Row`
    numbers : of the trials of each row
    """

    def __init__(
        self,
        tables: Sequence[str],
        names: Sequence[str],
        run: Callable[[list[Trial]], list[Row]],
        controller: str = "paper",
        numbers: Sequence[int] = range(2),
    ) -> None:
        self.names, self.controller = tuple(names), controller
        self._run, self._numbers = run, list(numbers)
        self.rows = [(name, *row) for name in tables for row in table_of(name).rows()]
        self.paper = np.array([table_of(name).paper[what, floor] for name, what, floor in self.rows])
        self._common = {name: Common(name, controller, PLANE) for name in tables}
        self._known: dict[Place, Array] = {}

    def means(self, places: Sequence[Place]) -> list[Array]:
        """The mean errors (R,) of the rows at each of some places, mm."""
        missing = [place for place in dict.fromkeys(places) if place not in self._known]
        trials = [trial for place in missing for trial in self._trials(place)]
        found = iter(self._run(trials)) if trials else iter(())
        for place in missing:
            outcomes = [Outcome.of([next(found) for _ in self._numbers]) for _ in self.rows]
            means = [o.errors.mean() if len(o.errors) else np.nan for o in outcomes]
            self._known[place] = np.array(means)
        return [self._known[place] for place in places]

    def _trials(self, place: Place) -> list[Trial]:
        varied = (*NOTHING_DRAWN, *zip(self.names, place, strict=True))
        return [
            Trial(self._common[table], what, floor, number, varied)
            for table, what, floor in self.rows
            for number in self._numbers
        ]


def fit_offsets(rows: Rows) -> Fit:
    """The offsets with which the means of rows are nearest to the paper's."""
    count = len(rows.names)
    (before,) = rows.means([(0.0,) * count])
    arrive = np.isfinite(before)

    def errors(x: Array) -> Array:
        """(1 + 2 N, R) from the paper's means, of the rows that arrive without: at a place, and beside it."""
        steps = [side * STEP * row for row in np.eye(count) for side in (1.0, -1.0)]
        means = np.array(rows.means([tuple((x + step).tolist()) for step in (0.0 * x, *steps)]))
        return np.nan_to_num(means[:, arrive], nan=MISSED) - rows.paper[arrive, 0]

    def slopes(x: Array) -> Array:
        _, *found = errors(x)
        return (np.array(found[::2]) - found[1::2]).T / (2.0 * STEP)

    assumed = np.eye(count) / ORDINARY
    fit = least_squares(
        lambda x: np.append(errors(x)[0], x / ORDINARY), np.zeros(count),
        lambda x: np.vstack([slopes(x), assumed]), bounds=(-LARGEST, LARGEST),
        loss="soft_l1", f_scale=TAIL, xtol=2e-2, max_nfev=MOST,
    )  # fmt: skip
    variance = np.sum(errors(fit.x)[0] ** 2) / max(1, arrive.sum() - count)
    deviations = np.sqrt(variance * np.diag(np.linalg.pinv(fit.jac.T @ fit.jac)))
    offsets, spread = (dict(zip(rows.names, map(float, each), strict=True)) for each in (fit.x, deviations))
    (after,) = rows.means([tuple(fit.x.tolist())])
    return Fit(offsets, spread, rows.rows, rows.paper, before, after)


def fit_lines(fit: Fit, others: Mapping[str, Array]) -> tuple[list[str], list[list[Any]]]:
    """Columns and lines: the paper, its controller without and with the offsets, and others with them."""
    columns = ["table", "object", "floor", "paper's mean [mm]", "deviation [mm]", "without [mm]", "with [mm]"]
    lines = [
        [*map(_words, row), *map(float, paper), float(before), float(after)]
        for row, paper, before, after in zip(fit.rows, fit.paper, fit.before, fit.after, strict=True)
    ]
    for name, means in others.items():
        columns.append(f"{name} [mm]")
        for line, mean in zip(lines, means, strict=True):
            line.append(float(mean))
    return columns, lines


def _words(name: str) -> str:
    return name.replace("_", " ")
