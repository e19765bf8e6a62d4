"""Numbers of replayed runs: errors against the truth where there is one, consistency, agreement with live."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_geometry import se3
from tactile_records.replay.run import Agreement
from tactile_records.runs.euler_poses import COMPONENTS, UNITS, euler_poses, euler_sigmas, inverses
from tactile_records.runs.metrics import angle_between, without_nan
from tactile_records.runs.record import BeliefSeries, TruthSeries

Array = NDArray[Any]

RECORDED = "recorded"
DOF = 6


@dataclass
class RunResult:
    """One run of one arm, for table and plot.

    Attributes
    ----------
    name : str
        Of the run; `RECORDED` for what the live filter published.
    beliefs : BeliefSeries
        Those that are valid.
    events, left_out : int
        What the filter took, and what the live one had not taken.
    """

    name: str
    arm: str
    beliefs: BeliefSeries
    events: int = 0
    left_out: int = 0
    resets: dict[str, int] = field(default_factory=dict)
    rejections: dict[str, int] = field(default_factory=dict)
    agreement: Agreement | None = None
    smoothed: bool = False


def numbers(result: RunResult, truth: TruthSeries) -> dict[str, Any]:
    """All numbers of a run; errors are NaN without truth."""
    series = result.beliefs
    X_fs = inverses(series.mean)
    mine, true = _matched(series.stamp_ns, truth)
    T_fs = truth.T_fs[true]
    error = (_euler_difference(euler_poses(X_fs[mine]), euler_poses(T_fs))) if len(mine) else np.zeros((0, 6))
    sigma = euler_sigmas(series.rows(mine)) if len(mine) else np.zeros((0, 6))
    with_nis = series.nis_dof > 0
    return {
        "beliefs": len(series),
        "events": result.events,
        "left_out": result.left_out,
        "refused": int((~series.accepted).sum()),
        "refused_by_reason": result.rejections,
        "resets": result.resets,
        "rms": dict(zip(COMPONENTS, _rms(error * UNITS).tolist(), strict=True)),
        "bias": dict(zip(COMPONENTS, _mean(error * UNITS).tolist(), strict=True)),
        "sigma": dict(zip(COMPONENTS, _rms(sigma * UNITS).tolist(), strict=True)),
        "normal_rms_deg": float(np.degrees(_rms(angle_between(X_fs[mine][:, 2, :3], T_fs[:, 2, :3])))),
        "in_2_sigma": float(_mean((np.abs(error) <= 2.0 * sigma).reshape(-1))),
        "nees_per_dof": _nees_per_dof(series.rows(mine), T_fs),
        "nis_per_dof": float(_mean(series.nis[with_nis] / series.nis_dof[with_nis])),
        "agreement": None if result.agreement is None else dataclasses.asdict(result.agreement),
    }


def write_report(path: Path, values: dict[str, Any]) -> None:
    """Write report.json; NaN becomes null."""
    path.write_text(json.dumps(without_nan(values), indent=2, sort_keys=True) + "\n")


TABLE = (
    "run",
    "beliefs",
    "refused",
    "restarts",
    "depth",
    "normal",
    "shear",
    "twist",
    "in 2σ",
    "NEES",
    "NIS",
    "live",
)


def table_row(result: RunResult, values: dict[str, Any]) -> list[str]:
    """A line of the table whose columns are `TABLE`: RMS errors in mm and degrees; NEES and NIS over 6."""
    rms = values["rms"]
    shear = float(np.hypot(rms["x"], rms["y"]))
    return [
        result.name,
        str(values["beliefs"]),
        str(values["refused"]),
        str(sum(count for reason, count in values["resets"].items() if reason != "no contact")),
        _text(rms["z"], 3),
        _text(values["normal_rms_deg"], 2),
        _text(shear, 3),
        _text(rms["gamma"], 2),
        _text(100.0 * values["in_2_sigma"], 0, " %"),
        _text(values["nees_per_dof"], 2),
        _text(values["nis_per_dof"], 2),
        _agreement_text(result.agreement),
    ]


def _agreement_text(agreement: Agreement | None) -> str:
    if agreement is None:
        return "–"
    if agreement.identical == agreement.common:
        return "same"
    return f"{agreement.identical}/{agreement.common}"


def _matched(stamps: Array, truth: TruthSeries) -> tuple[Array, Array]:
    """Rows of the beliefs and of the truth that are of one exposure, where there is contact in truth."""
    _, mine, true = np.intersect1d(stamps, truth.stamp_ns, return_indices=True)
    known = np.isfinite(truth.T_fs[true]).all(axis=(1, 2)) & truth.in_contact[true].astype(bool)
    return mine[known], true[known]


def _euler_difference(a: Array, b: Array) -> Array:
    difference = a - b
    difference[:, 3:] = (difference[:, 3:] + np.pi) % (2.0 * np.pi) - np.pi
    return difference


def _nees_per_dof(series: BeliefSeries, T_fs: Array) -> float:
    """Mean normalized error squared of X_sf over its degrees of freedom: 1 for a consistent filter."""
    if not len(series):
        return float("nan")
    errors = [
        se3.log(T_sf @ se3.inverse(mean)) for T_sf, mean in zip(inverses(T_fs), series.mean, strict=True)
    ]
    solved = np.linalg.solve(series.cov, np.array(errors)[:, :, None])[:, :, 0]
    return float((np.array(errors) * solved).sum(axis=1).mean()) / DOF


def _rms(values: Array) -> Array:
    """Root of the mean square along the first axis; NaN where there is none."""
    shape = values.shape[1:]
    return np.sqrt((values**2).mean(axis=0)) if len(values) else np.full(shape, np.nan)


def _mean(values: Array) -> Array:
    return np.asarray(values.mean(axis=0)) if len(values) else np.full(values.shape[1:], np.nan)


def _text(value: float, digits: int, unit: str = "") -> str:
    return f"{value:.{digits}f}{unit}" if np.isfinite(value) else "–"
