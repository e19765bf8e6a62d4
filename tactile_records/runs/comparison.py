"""What differs between runs: in their settings, and in their numbers by more than runs of one kind do.

Runs with the same task, scene and settings are a group, whatever their seeds. Each group is held against the
first one: two groups of several runs by Welch's t test, one run against several by their prediction interval,
and of one run against one nothing can be said. All verdicts of a comparison together are wrong with a
probability of at most `WRONG` (Holm's correction), where numbers are about normally distributed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from tactile_base.input_file import parse_json
from tactile_records.runs.from_bag import of_arms, read_runs
from tactile_records.runs.metrics import without_nan
from tactile_records.runs.report import report_of
from tactile_records.runs.settings_given import plain, settings_of

Array = NDArray[np.float64]

WRONG = 0.05
REPORT = "report.json"
IDENTITY = ("scene", "task", "task_file", "role", "arm", "source")  # of a report: what makes runs of one kind
_NO_RESULT = ("seed", "wall_s")  # numbers of a report that say nothing about how well it went
_OF_THE_RUN = ("seed", "scene")  # what a simulation is given: differs between runs of one kind, or is told

LARGER, WITHIN, UNTOLD = "larger than the spread", "within the spread", "nothing to say"


@dataclass(frozen=True)
class ComparedRun:
    """One arm of one run.

    Attributes
    ----------
    source : where it was read from, as a person gave it
    identity : `IDENTITY` of its report
    settings : NODE NAME -> value
    numbers : dotted name in its report -> value; true is 1
    """

    source: str
    arm: str
    identity: dict[str, Any]
    settings: dict[str, Any]
    numbers: dict[str, float]


@dataclass
class Group:
    """Runs with the same settings."""

    name: str
    runs: list[ComparedRun] = field(default_factory=list)

    def values(self, number: str) -> Array:
        """A number of those runs that have it."""
        return np.array([run.numbers[number] for run in self.runs if number in run.numbers])


@dataclass(frozen=True)
class Difference:
    """A number of a group held against that of the first.

    Attributes
    ----------
    first, second : ndarray
        The values of the runs of either.
    verdict : `LARGER`, `WITHIN` or `UNTOLD`
    why : what the verdict rests on
    """

    number: str
    group: str
    first: Array
    second: Array
    verdict: str
    why: str

    @property
    def size(self) -> float:
        """By how much the means differ."""
        return float(self.second.mean() - self.first.mean())


def read_compared(sources: Sequence[Path]) -> list[ComparedRun]:
    """All arms of the runs in some recordings, records or folders with report.json.

    `ValueError` where one is named twice, or holds nothing that can be compared.
    """
    seen: dict[Path, Path] = {}
    for source in sources:
        first = seen.setdefault(source.resolve(), source)
        if first is not source:
            raise ValueError(f"{source} is named twice: a run does not differ from itself")
    return [run for source in sources for run in _runs_of(source)]


def _runs_of(source: Path) -> Iterator[ComparedRun]:
    reports = [source] if source.name == REPORT else of_arms(source, REPORT)
    if reports:
        for path in reports:
            yield _of_report(str(source), _read(path))
        return
    records = read_runs(source)
    for record in records.values():
        values = without_nan(report_of(record.task).numbers(record, records))
        yield _of_report(str(source), {**values, "settings": record.settings})


def _read(path: Path) -> dict[str, Any]:
    try:
        values = parse_json(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path}: is no JSON: {error}") from error
    if not isinstance(values, dict) or "arm" not in values or "task" not in values:
        raise ValueError(f"{path}: is no report of a run: it has no arm and task")
    return values


def _of_report(source: str, values: Mapping[str, Any]) -> ComparedRun:
    given = settings_of(values.get("settings") or {}, values["task"])
    settings = {f"{node} {name}": plain(value) for node, name, value, _ in given}
    results = {k: v for k, v in values.items() if k not in (*IDENTITY, *_NO_RESULT, "settings", "origin")}
    return ComparedRun(
        source, values["arm"], {k: values.get(k) for k in IDENTITY}, settings, dict(_numbers(results))
    )


def _numbers(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _numbers(value, f"{prefix}{name}.")
        elif isinstance(value, bool | int | float) and math.isfinite(value):
            yield f"{prefix}{name}", float(value)


# ---- groups ----


def differing_settings(runs: Sequence[ComparedRun]) -> dict[str, list[Any]]:
    """What is not the same in all of these runs -> its value in each; None where a run does not have it."""
    rows = [_kind(run) for run in runs]
    names = dict.fromkeys(name for row in rows for name in row)
    found = {name: [row.get(name) for row in rows] for name in names}
    return {name: values for name, values in found.items() if len({_key(value) for value in values}) > 1}


def _kind(run: ComparedRun) -> dict[str, Any]:
    settings = {k: v for k, v in run.settings.items() if k.rpartition(" ")[2] not in _OF_THE_RUN}
    return {**run.identity, **settings}


def _key(value: Any) -> str:
    return json.dumps(value, sort_keys=True, default=str)


def groups_of(runs: Sequence[ComparedRun]) -> list[Group]:
    """The runs of one arm by what they have the same, in the order in which they come: A, B, ..."""
    found: dict[str, Group] = {}
    for run in runs:
        key = _key(_kind(run))
        found.setdefault(key, Group(_letters(len(found)))).runs.append(run)
    return list(found.values())


def _letters(number: int) -> str:
    """A to Z, then AA."""
    rest, last = divmod(number, 26)
    return (_letters(rest - 1) if rest else "") + chr(ord("A") + last)


# ---- differences ----


def differences(groups: Sequence[Group]) -> list[Difference]:
    """Of each further group from the first, in all numbers that both have; see the module's text."""
    first, tests = groups[0], []
    for group in groups[1:]:
        for number in first.runs[0].numbers:
            one, other = first.values(number), group.values(number)
            if len(one) and len(other):
                tests.append((number, group.name, one, other, *_test(one, other)))
    limits = _holm([p for *_, p, _ in tests])
    return [
        Difference(number, name, one, other, _verdict(p, limit), why)
        for (number, name, one, other, p, why), limit in zip(tests, limits, strict=True)
    ]


def _test(one: Array, other: Array) -> tuple[float, str]:
    """Probability of so large a difference between runs of one kind, NaN where untold; what it rests on."""
    if len(one) < 2 and len(other) < 2:
        return math.nan, "one run of each: how runs of one kind differ is not known"
    if one.std() < _rounding(one) and other.std() < _rounding(other):
        return math.nan, "all runs of a kind have the same value: there is no spread to hold it against"
    if len(one) > 1 and len(other) > 1:
        return float(stats.ttest_ind(one, other, equal_var=False).pvalue), "Welch's t test"
    many, single = (one, float(other[0])) if len(one) > 1 else (other, float(one[0]))
    if many.std() < _rounding(many):
        return math.nan, "all runs but one have the same value: there is no spread to hold that one against"
    scale = float(many.std(ddof=1)) * math.sqrt(1.0 + 1.0 / len(many))
    return float(2.0 * stats.t.sf(abs(single - many.mean()) / scale, len(many) - 1)), "prediction interval"


def _rounding(values: Array) -> float:
    return 1e-9 * max(1e-9, float(np.abs(values).max()))


def _holm(probabilities: Sequence[float]) -> list[float]:
    """The level that each probability has to be below, of all those that are known (Holm 1979)."""
    known = sorted((p, k) for k, p in enumerate(probabilities) if math.isfinite(p))
    levels, going_on = [0.0] * len(probabilities), True
    for rank, (p, k) in enumerate(known):
        level = WRONG / (len(known) - rank)
        going_on = going_on and p < level
        levels[k] = level if going_on else 0.0
    return levels


def _verdict(p: float, level: float) -> str:
    if not math.isfinite(p):
        return UNTOLD
    return LARGER if p < level else WITHIN
