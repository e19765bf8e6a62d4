"""The filter experiment over several models, noises and orders, with its table, files and figure."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from tactile_base.console import number_table
from tactile_base.whole_file import write_csv
from tactile_filter.bayes_filter import FilterSettings
from tactile_perception.estimating.labels import NETWORK_COLUMNS, NETWORK_TITLES
from tactile_perception.estimating.plots import Row, draw_predicted_against_actual
from tactile_perception.evaluation import filtering
from tactile_perception.evaluation.evaluate import EvaluationData, ModelResult
from tactile_perception.evaluation.filtering import ContactSequence, FilterRun
from tactile_perception.evaluation.metrics import Predictions
from tactile_perception.evaluation.plots import best
from tactile_perception.evaluation.report import about, file_name, groups, with_spread

Array = NDArray[np.float64]
#: The paper's noises of the motion, in mm and degrees.
SIGMAS = (math.inf, 10.0, 1.0, 0.1, 0.01)
_FITTED = 500
_PAPER_FILTER = FilterSettings(gate_probability=1.0)


@dataclass(frozen=True)
class Experiment:
    """What is run.

    Attributes
    ----------
    sigmas : noises sigma_psi of the motion in mm and degrees; infinity is the network alone
    seeds : orders (and noises), over which results are averaged
    estimated : also with sigma_phi estimated instead of equal to sigma_psi
    settings : of the filter, but for its process noise
    """

    sigmas: tuple[float, ...] = SIGMAS
    seeds: tuple[int, ...] = (0,)
    estimated: bool = False
    settings: FilterSettings = _PAPER_FILTER

    @property
    def cases(self) -> list[tuple[float, str]]:
        """(sigma_psi, how sigma_phi is chosen) of everything that is run."""
        return [
            (sigma, noise)
            for sigma in self.sigmas
            for noise in (("equal", "estimated") if self.estimated and math.isfinite(sigma) else ("equal",))
        ]

    @property
    def runs(self) -> int:
        """Sequences to be filtered for one model in one state."""
        return len(self.seeds) * len(self.cases)


@dataclass(frozen=True)
class FilterResult:
    """One model at one sigma_psi, means over the orders.

    Attributes
    ----------
    state : "raw" or "calibrated"
    noise : "equal" (sigma_phi = sigma_psi, as in the paper) or "estimated"
    mae : (6,) in mm and rad
    nees, nis : joint, divided by 6
    """

    model: str
    kind: str
    state: str
    sigma_psi: float
    noise: str
    sigma_phi: float
    mae: Array
    nees: float
    nis: float


def run_experiment(
    data: EvaluationData,
    results: Sequence[ModelResult],
    experiment: Experiment,
    progress: Callable[[int], None] = lambda count: None,
) -> list[FilterResult]:
    """Filter the data set's sequences for every model that has uncertainty, raw and calibrated."""
    sequences = {
        (sigma, seed): filtering.contact_sequence(data, sigma if math.isfinite(sigma) else 0.0, seed)
        for sigma in experiment.sigmas
        for seed in experiment.seeds
    }
    found = []
    for result, state, predictions in states(results):
        measurements = filtering.pose_gaussians(predictions)
        for sigma, noise in experiment.cases:
            runs = []
            for seed in experiment.seeds:
                runs.append(_one(sequences[sigma, seed], predictions, measurements, sigma, noise, experiment))
                progress(1)
            found.append(_mean_result(result, state, sigma, noise, runs))
    return found


def states(results: Sequence[ModelResult]) -> Iterator[tuple[ModelResult, str, Predictions]]:
    """(result, state, predictions) of everything that a filter can take."""
    for result in results:
        for state, assessment in (("raw", result.raw), ("calibrated", result.calibrated)):
            if assessment is not None and assessment.predictions.cov is not None:
                yield result, state, assessment.predictions


def _one(
    sequence: ContactSequence,
    predictions: Predictions,
    measurements: Sequence[Any],
    sigma: float,
    noise: str,
    experiment: Experiment,
) -> tuple[float, FilterRun]:
    """sigma_phi and the filtered sequence."""
    if not math.isfinite(sigma):
        return math.inf, filtering.unfiltered(sequence, predictions)
    phi = sigma
    if noise == "estimated":
        beginning = replace(sequence, order=sequence.order[:_FITTED])
        phi = filtering.estimate_process_noise(beginning, measurements)
    return phi, filtering.run_filter(sequence, measurements, phi, experiment.settings)


def _mean_result(
    result: ModelResult, state: str, sigma: float, noise: str, runs: Sequence[tuple[float, FilterRun]]
) -> FilterResult:
    return FilterResult(
        model=result.name,
        kind=result.name if result.members > 1 else result.kind,
        state=state,
        sigma_psi=sigma,
        noise=noise,
        sigma_phi=float(np.mean([phi for phi, _ in runs])),
        mae=np.mean([run.mae for _, run in runs], axis=0),
        nees=float(np.mean([run.nees for _, run in runs])),
        nis=float(np.mean([run.nis for _, run in runs])),
    )


def filter_tables(found: Sequence[FilterResult], goal: dict[float, Array] | None = None) -> list[Table]:
    """The paper's table for each kind of model, state and choice of sigma_phi.

    `goal` is the MAE (6,) by sigma_psi, shown in brackets with + where it is reached, else -.
    """
    keys = dict.fromkeys((entry.kind, entry.state, entry.noise) for entry in found)
    tables = []
    for kind, state, noise in keys:
        entries = [entry for entry in found if (entry.kind, entry.state, entry.noise) == (kind, state, noise)]
        tables.append(_filter_table(entries, f"{kind}, {state}, sigma_phi {noise}", goal or {}))
    return tables


def _filter_table(entries: Sequence[FilterResult], name: str, goal: dict[float, Array]) -> Table:
    sigmas = list(dict.fromkeys(entry.sigma_psi for entry in entries))
    by_sigma = {sigma: [entry for entry in entries if entry.sigma_psi == sigma] for sigma in sigmas}
    count = len(by_sigma[sigmas[0]])
    models = f"{count} models, mean ± deviation" if count > 1 else entries[0].model
    title = f"filtered mean absolute errors: {name} ({models})"
    table = number_table(title, ["sigma_psi (mm, deg)", *(f"{sigma:g}" for sigma in sigmas)])
    for component, label in enumerate(NETWORK_TITLES):
        cells = []
        for sigma in sigmas:
            values = [entry.mae[component] for entry in by_sigma[sigma]]
            wanted = goal[sigma][component] if sigma in goal else None
            cells.append(with_spread(values) + _compared(float(np.mean(values)), wanted))
        table.add_row(label, *cells)
    table.add_section()
    for label, attribute in (("NEES / 6", "nees"), ("NIS / 6", "nis"), ("sigma_phi", "sigma_phi")):
        columns = ([getattr(entry, attribute) for entry in by_sigma[sigma]] for sigma in sigmas)
        table.add_row(label, *("-" if not np.isfinite(v).all() else with_spread(v, 3) for v in columns))
    return table


def _compared(value: float, wanted: float | None) -> str:
    """The number to compare with, of four digits as in the paper, and whether it is reached."""
    return "" if wanted is None else f" ({'+' if round(value, 4) <= wanted else '-'}{wanted:.4f})"


def write_filter_files(out: Path, found: Sequence[FilterResult]) -> None:
    """`filter.csv`, one row a model, state, noise and sigma."""
    names = ["model", "kind", "state", "sigma_psi", "noise"]
    numbers = ["sigma_phi", *(f"mae_{column}" for column in NETWORK_COLUMNS), "nees_per_dof", "nis_per_dof"]
    rows = []
    for entry in found:
        values = [entry.sigma_phi, *entry.mae, entry.nees, entry.nis]
        texts = ["" if math.isnan(value) else f"{value:.6g}" for value in values]
        rows.append([entry.model, entry.kind, entry.state, f"{entry.sigma_psi:g}", entry.noise, *texts])
    write_csv(out / "filter.csv", [*names, *numbers], rows)


def filter_summary(data: EvaluationData, found: Sequence[FilterResult]) -> dict[str, Any]:
    """The results as plain types, for JSON."""
    plain = []
    for entry in found:
        values = {**vars(entry), "mae": entry.mae.tolist()}
        plain.append({key: _finite(value) for key, value in values.items()})
    return {**about(data), "results": plain}


def _finite(value: Any) -> Any:
    """JSON has no infinity: as text; NaN as null."""
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else "inf"
    return value


def draw_filter_figure(
    out: Path, data: EvaluationData, results: Sequence[ModelResult], experiment: Experiment
) -> list[Path]:
    """The paper's figure of the best model of each kind: predicted against actual at each sigma_psi."""
    paths = []
    for name, members in groups(results).items():
        result = best(members)
        if result.raw.consistency is None:
            continue
        measurements = filtering.pose_gaussians(result.best.predictions)
        rows: list[Row] = []
        for sigma in experiment.sigmas:
            noise = sigma if math.isfinite(sigma) else 0.0
            sequence = filtering.contact_sequence(data, noise, experiment.seeds[0])
            predictions = result.best.predictions
            _, run = _one(sequence, predictions, measurements, sigma, "equal", experiment)
            rows.append((f"sigma_psi {sigma:g}", sequence.labels, run.mean, run.sigma))
        path = out / f"filter_{file_name(name)}.png"
        draw_predicted_against_actual(path, rows, f"{data.folder.name}, {result.name}, with filter")
        paths.append(path)
    return paths
