"""What models of planar friction make of real pushes: a table by file and model."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_base.whole_file import whole_file
from tactile_bringup.experiments.real_pushes import (
    CENTER,
    end_error,
    predicted_end,
    read_pushes,
    shares_of,
    slide_of,
    slope_of,
    support_of,
)
from tactile_sim.planar_friction import ConvexPolynomial, Ellipsoid, FrictionModel, PointCoulomb

Array = NDArray[np.float64]

MODELS = ("ellipsoid", "points", "polynomial")
_RESAMPLED = 2000
_GRIPPED = 0.95  # of the finger's forces lie within its cone of friction at the edge
COLUMNS = ["support", "model", "motion (deg)", "friction (N)", "end (mm)", "end (deg)", "a motion (us)"]


@dataclass(frozen=True)
class Band:
    """Median over pushes, and the interval in which 95 % of the medians of resampled pushes lie."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Array) -> Band:
        """By the bootstrap, seed 0."""
        drawn = np.random.default_rng(0).integers(0, len(values), (_RESAMPLED, len(values)))
        low, high = np.quantile(np.median(values[drawn], axis=1), [0.025, 0.975])
        return cls(float(np.median(values)), float(low), float(high))

    def __str__(self) -> str:
        return f"{self.median:.2f} [{self.low:.2f}, {self.high:.2f}]"


@dataclass(frozen=True)
class Result:
    """One model on the pushes of one file.

    Attributes
    ----------
    motion : angle between predicted and measured motion by the measured load, deg
    friction : that the floor has in all, by the measured loads, N
    end_mm, end_deg : of the whole push predicted by the finger's way alone, at `CENTER`
    microseconds : a motion by its load, of many at once
    polynomial : fitted to all pushes, as a scene's `polynomial` has it; of other models nothing
    """

    file: str
    model: str
    pushes: int
    motion: Band
    friction: Band
    end_mm: Band
    end_deg: Band
    microseconds: float
    polynomial: list[float]


class _Trials:
    """The pushes of a file with what they say of friction, in the models' unit."""

    def __init__(self, path: Path) -> None:
        self.file, self.pushes = path.stem, read_pushes(path)
        if len(self.pushes) < 4:
            raise ValueError(f"{path}: {len(self.pushes)} pushes are too few: models are fitted to one half")
        points = support_of(path)
        shares, arms = shares_of(points), points - CENTER
        self.length = math.sqrt(float(shares @ (arms**2).sum(axis=1)))
        slides = [slide_of(push) for push in self.pushes]
        self.slopes = np.array([slope_of(*pair) for pair in zip(self.pushes, slides, strict=True)])
        self.loads = np.array([slide.load for slide in slides]) / [1.0, 1.0, self.length]
        motions = np.array([slide.motion for slide in slides]) * [1.0, 1.0, self.length]
        self.motions = motions / np.linalg.norm(motions, axis=1)[:, None]
        self.ellipsoid = Ellipsoid(1.0, float(shares @ np.linalg.norm(arms, axis=1)) / self.length)
        self.points = PointCoulomb(arms / self.length, shares)

    def model(self, name: str, fitted_to: NDArray[np.bool_]) -> FrictionModel:
        """A model of friction of 1 N in all."""
        if name == "ellipsoid":
            return self.ellipsoid
        if name == "points":
            return self.points
        loads = self.loads[fitted_to]
        start = Ellipsoid(float(np.median(self.ellipsoid.size(loads))), self.ellipsoid.arm)
        fitted = ConvexPolynomial.fit(loads, self.motions[fitted_to], start)
        return ConvexPolynomial(fitted.squares * start.force**2)

    def result(self, name: str) -> Result:
        """Of a model that is fitted to every other push and tried on those between, and the reverse."""
        angle, size, end, turn, spent = np.zeros((5, len(self.pushes)))
        for parity in range(2):
            tried = np.arange(len(self.pushes)) % 2 == parity
            model = self.model(name, ~tried)
            grip = float(np.quantile(self.slopes[~tried], _GRIPPED))
            start = time.perf_counter()
            found = model.motion(self.loads[tried])
            spent[tried] = (time.perf_counter() - start) / tried.sum()
            cosine = (found * self.motions[tried]).sum(axis=1)
            angle[tried] = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
            size[tried] = model.size(self.loads[tried])
            for k in np.flatnonzero(tried):
                end[k], turn[k] = end_error(
                    self.pushes[k], predicted_end(self.pushes[k], model, self.length, grip)
                )
        return Result(
            self.file, name, len(self.pushes), Band.of(angle), Band.of(size), Band.of(1e3 * end),
            Band.of(np.degrees(turn)), 1e6 * float(spent.mean()),
            self._polynomial() if name == "polynomial" else [],
        )  # fmt: skip

    def _polynomial(self) -> list[float]:
        fitted = self.model("polynomial", np.ones(len(self.pushes), bool))
        assert isinstance(fitted, ConvexPolynomial)
        return [float(number) for square in fitted.squares for number in square[np.triu_indices(3)]]


def results_of_files(files: Sequence[Path]) -> list[Result]:
    """All models on all files; all are read before any is worked on."""
    return [trials.result(name) for trials in [_Trials(path) for path in files] for name in MODELS]


def cells(result: Result) -> list[str]:
    """A row under `COLUMNS`."""
    numbers = (result.motion, result.friction, result.end_mm, result.end_deg)
    return [result.file, result.model, *map(str, numbers), f"{result.microseconds:.1f}"]


def write_results(folder: Path, results: Sequence[Result]) -> list[Path]:
    """All numbers as JSON, and the table in Markdown."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = [COLUMNS, ["---"] * len(COLUMNS), *map(cells, results)]
    table = "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"
    texts = {
        "real_pushes.json": json.dumps([asdict(result) for result in results], indent=2),
        "real_pushes.md": table,
    }
    for name, text in texts.items():
        with whole_file(folder / name) as temporary:
            temporary.write_text(text)
    return [folder / name for name in texts]
