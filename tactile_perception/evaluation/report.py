"""Tables and files of an evaluation, with the paper's numbers to compare with; everything as CSV and JSON."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from tactile_base.config_paths import config_path
from tactile_base.console import number_table
from tactile_base.whole_file import write_csv
from tactile_base.yaml_file import read_yaml
from tactile_perception.estimating.labels import (
    EULER_COMPONENTS,
    EULER_TITLES,
    NETWORK_TITLES,
)
from tactile_perception.evaluation.evaluate import Assessment, EvaluationData, ModelResult
from tactile_perception.evaluation.metrics import LEVELS, Bins

Array = NDArray[np.float64]
_PAPER_TABLES = "perception/tables_lloyd_lepora.yaml"


def groups(results: Sequence[ModelResult]) -> dict[str, list[ModelResult]]:
    """Results by what their models are; an ensemble is a group of its own."""
    found: dict[str, list[ModelResult]] = {}
    for result in results:
        key = result.name if result.members > 1 else result.kind
        found.setdefault(key, []).append(result)
    return found


def spread(values: Sequence[Any] | Array) -> tuple[Array, Array]:
    """Mean and sample standard deviation over models (the first axis); NaN where there is only one."""
    array = np.asarray(values, dtype=np.float64)
    return array.mean(axis=0), array.std(axis=0, ddof=1) if len(array) > 1 else np.full(
        array.shape[1:], np.nan
    )


def with_spread(values: Sequence[float] | Array, digits: int = 4) -> str:
    """Mean and standard deviation as in the paper's tables."""
    mean, deviation = spread(values)
    text = f"{mean:.{digits}f}"
    return text if np.isnan(deviation) else f"{text} ± {deviation:.{digits}f}"


def accuracy_table(results: Sequence[ModelResult], reference: ReferenceTables | None = None) -> Table:
    """The paper's table of losses and mean absolute errors, with the Euler pose's below.

    `reference` adds the columns of another's results.
    """
    columns = groups(results)
    networks = {} if reference is None else reference.networks
    heads = [
        name if len(members) == 1 else f"{name}, {len(members)} models" for name, members in columns.items()
    ]
    table = number_table("mean absolute errors", ["", *heads, *(f"paper, {name}" for name in networks)])

    def row(label: str, value: Callable[[ModelResult], float | None], others: Sequence[str] = ()) -> None:
        found = [[value(member) for member in members] for members in columns.values()]
        known = [[value for value in values if value is not None] for values in found]
        cells = [with_spread(values) if values else "-" for values in known]
        table.add_row(label, *cells, *others)

    losses = {name: f"{loss:.4f}" for name, (loss, _) in networks.items()}
    nll = [losses[name] if name != "CNN" else "" for name in losses]
    mse = [losses[name] if name == "CNN" else "" for name in losses]
    row("mean NLL", lambda result: result.raw.consistency.nll if result.raw.consistency else None, nll)
    row("weighted MSE", lambda result: result.accuracy.mse, mse)
    table.add_section()
    for index, name in enumerate(results[0].titles):
        at = NETWORK_TITLES.index(name) if name in NETWORK_TITLES else None
        others = ["" if at is None else f"{mae[at]:.4f}" for _, mae in networks.values()]
        row(name, lambda result, index=index: result.accuracy.mae[index], others)  # type: ignore[misc]
    table.add_section()
    for index, name in enumerate(EULER_TITLES):
        if np.isnan(results[0].accuracy.euler_mae[index]):
            continue
        row(name, lambda result, index=index: result.accuracy.euler_mae[index])  # type: ignore[misc]
    return table


def calibration_table(members: Sequence[ModelResult], name: str) -> Table | None:
    """NEES and coverage before and after calibration, means over models; None without uncertainty."""
    if any(member.raw.consistency is None for member in members):
        return None
    states: list[tuple[str, Callable[[ModelResult], Assessment]]] = [("raw", lambda m: m.raw)]
    if all(member.calibrated for member in members):
        states.append(("calibrated", lambda m: m.best))
    count = int(members[0].raw.by_depth.count.sum())
    interval = members[0].raw.consistency
    assert interval is not None
    low, high = interval.joint_interval
    table = number_table(
        f"{name}: NEES (more than 1: overconfident) and coverage in %\n"
        f"a right joint NEES / {len(members[0].names)} of {count} samples lies in "
        f"[{low:.3f}, {high:.3f}] with 95 %",
        ["", *members[0].names, "joint", "mean NLL"],
    )
    for state, choose in states:
        found = [choose(member).consistency for member in members]
        rows = [consistency for consistency in found if consistency is not None]
        cells = [with_spread(column, 2) for column in np.array([c.nees for c in rows]).T]
        joint, nll = with_spread([c.joint for c in rows], 3), with_spread([c.nll for c in rows], 2)
        table.add_row(f"NEES, {state}", *cells, joint, nll)
        for level, percent in zip(LEVELS, np.mean([c.coverage for c in rows], axis=0) * 100.0, strict=True):
            table.add_row(f"within {level:.0%}", *(f"{value:.1f}" for value in percent), "", "")
    return table


def bins_table(members: Sequence[ModelResult], name: str, which: str) -> Table:
    """MAE by depth or by shear (`by_depth`, `by_shear`), means over models."""
    bins: list[Bins] = [getattr(member.best, which) for member in members]
    edges, count = bins[0].edges, bins[0].count
    chosen = np.flatnonzero(count)
    heads = [f"{edges[index]:g} to {edges[index + 1]:g}" for index in chosen]
    table = number_table(f"{name}: mean absolute error {which.replace('_', ' ')} (mm)", ["", *heads])
    table.add_row("samples", *(str(count[index]) for index in chosen))
    mae = np.mean([b.mae for b in bins], axis=0)
    for component, label in enumerate(members[0].titles):
        table.add_row(label, *(f"{mae[index, component]:.4f}" for index in chosen))
    return table


def about(data: EvaluationData) -> dict[str, Any]:
    """What a summary begins with: the data, notes on them, and the components of errors."""
    return {
        "data": {"folder": str(data.folder), "samples": len(data), "sha256": data.sha256},
        "notes": data.notes,
        "components": [data.model.titles[k] for k in data.compared],
    }


def summary(data: EvaluationData, results: Sequence[ModelResult]) -> dict[str, Any]:
    """Everything but the predictions as plain types, for JSON."""
    return {
        **about(data),
        "coverage_levels": list(LEVELS),
        "models": [_plain_result(result) for result in results],
        "groups": {name: _plain_group(members) for name, members in groups(results).items()},
    }


def _plain_result(result: ModelResult) -> dict[str, Any]:
    plain: dict[str, Any] = {
        "name": result.name,
        "kind": result.kind,
        "members": result.members,
        "accuracy": _plain(result.accuracy),
        "raw": _plain_assessment(result.raw),
    }
    if result.calibrated is not None:
        plain["calibrated"] = _plain_assessment(result.calibrated)
        plain["calibration"] = result.calibration_source
    return plain


def _plain_assessment(assessment: Assessment) -> dict[str, Any]:
    parts = {
        name: _plain(getattr(assessment, name))
        for name in ("consistency", "by_sigma", "by_depth", "by_shear")
    }
    return {name: value for name, value in parts.items() if value is not None}


def _plain_group(members: Sequence[ModelResult]) -> dict[str, Any]:
    """Mean and deviation over the models of the numbers that the paper's table has."""
    found: dict[str, Any] = {"models": len(members)}
    for name in ("mse", "mae", "euler_mae"):
        found[name] = _mean_and_deviation([getattr(member.accuracy, name) for member in members])
    for state in ("raw", "calibrated"):
        assessments = [getattr(member, state) for member in members]
        if any(assessment is None or assessment.consistency is None for assessment in assessments):
            continue
        for name in ("nll", "joint", "nees", "coverage"):
            values = [getattr(assessment.consistency, name) for assessment in assessments]
            found[f"{state}_{name}"] = _mean_and_deviation(values)
    return found


def _mean_and_deviation(values: Sequence[Any]) -> dict[str, Any]:
    return dict(zip(("mean", "deviation"), map(_plain, spread(values)), strict=True))


def _plain(value: Any) -> Any:
    """Data classes, arrays and numbers as JSON has them; what is not finite becomes null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(element) for element in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value


def write_files(out: Path, data: EvaluationData, results: Sequence[ModelResult]) -> None:
    """`results.json`, `results.csv` (one number a row), and each model's predictions as a table."""
    text = json.dumps(summary(data, results), indent=1, allow_nan=False)
    (out / "results.json").write_text(text + "\n")
    rows = ((result.name, result.kind, *row) for result in results for row in _rows(result))
    write_csv(out / "results.csv", ["model", "kind", "state", "quantity", "component", "value"], rows)
    for result in results:
        _write_predictions(out / f"predictions_{file_name(result.name)}.csv", data, result)


def file_name(name: str) -> str:
    """A model's or kind's name as part of a file's name."""
    return re.sub(r"[^\w.-]+", "_", name).strip("_")


def _rows(result: ModelResult) -> Iterator[tuple[str, str, str, str]]:
    """(state, quantity, component, value) of every number that does not come from bins."""
    accuracy = result.accuracy
    yield "", "weighted MSE", "", f"{accuracy.mse:.6g}"
    for quantity, values in (("MAE", accuracy.mae), ("RMSE", accuracy.rmse), ("bias", accuracy.bias)):
        for component, value in zip(result.names, values, strict=True):
            yield "", quantity, component, f"{value:.6g}"
    for component, value in zip(EULER_COMPONENTS, accuracy.euler_mae, strict=True):
        if np.isnan(value):
            continue
        yield "", "MAE", component, f"{value:.6g}"
    for state in ("raw", "calibrated"):
        assessment = getattr(result, state)
        consistency = None if assessment is None else assessment.consistency
        if consistency is None:
            continue
        yield state, "mean NLL", "", f"{consistency.nll:.6g}"
        yield state, f"joint NEES / {len(result.names)}", "", f"{consistency.joint:.6g}"
        for component, value in zip(result.names, consistency.nees, strict=True):
            yield state, "NEES", component, f"{value:.6g}"
        for level, row in zip(LEVELS, consistency.coverage, strict=True):
            for component, value in zip(result.names, row, strict=True):
                yield state, f"coverage at {level:.0%}", component, f"{value:.6g}"


def _write_predictions(path: Path, data: EvaluationData, result: ModelResult) -> None:
    header = [f"{kind}_{column}" for kind in ("label", "predicted") for column in result.columns]
    columns = [data.targets, result.raw.predictions.mean]
    for state in ("raw", "calibrated"):
        assessment = getattr(result, state)
        if assessment is not None and assessment.consistency is not None:
            header += [f"{state}_sigma_{column}" for column in result.columns]
            columns.append(assessment.predictions.sigma)
    lines = zip(data.names, np.hstack(columns).tolist(), strict=True)
    write_csv(path, ["image", *header], ([name, *(f"{value:.6g}" for value in row)] for name, row in lines))


@dataclass(frozen=True)
class ReferenceTables:
    """Mean absolute errors (6,) in mm and rad.

    Attributes
    ----------
    networks : loss and errors by kind of network
    filter : errors by sigma_psi in mm and degrees
    """

    networks: dict[str, tuple[float, Array]] = field(default_factory=dict)
    filter: dict[float, Array] = field(default_factory=dict)


def paper_tables() -> ReferenceTables:
    """The paper's tables; `SettingError` or `OSError` if the file is not as it was shipped."""
    root = read_yaml(config_path(_PAPER_TABLES))
    root.allow("networks", "filter")
    filtered = root.section("filter")
    return ReferenceTables(
        networks={
            kind: (section.number("loss"), np.array(section.numbers("mae", 6)))
            for kind, section in root.sections("networks").items()
        },
        filter={float(key): np.array(filtered.numbers(key, 6)) for key in filtered.values},
    )
