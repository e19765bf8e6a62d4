"""Reports of runs: report.json and pictures, by what the arm's task wants to show.

A task brings its report as one file and one entry of `REPORTS`, or of the entry-point group
tactile_servoing.reports; an arm whose task has none gets the numbers that all tasks share.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_base.contract import Contract
from tactile_base.registry import Registry
from tactile_records.runs import metrics
from tactile_records.runs.record import RunRecord

if TYPE_CHECKING:
    from tactile_records.runs.figures import Picture

Run = Mapping[str, RunRecord]  # all arms of a run, by name
FILES = ("report.json", "*/report.json")  # by which a folder of results is known: of one arm, of several


@dataclass(frozen=True)
class TaskReport:
    """What a report of a task shows of one arm; all of it may look at the other arms of the run as well.

    Attributes
    ----------
    fields : dotted name of each number -> its meaning and unit; the schema of report.json
    numbers : record and run -> numbers, nested as the names of `fields` are dotted
    summary : numbers -> rows for a person: (name, value with unit, requirement where there is one)
    pictures : file name -> what draws it
    """

    fields: Mapping[str, str]
    numbers: Callable[[RunRecord, Run], dict[str, Any]]
    summary: Callable[[Mapping[str, Any]], list[tuple[str, str, str]]]
    pictures: Mapping[str, Picture]


REPORTS: Registry[TaskReport] = Registry(
    "report",
    "tactile_servoing.reports",
    {
        "surface_following": "tactile_records.runs.surface_following:REPORT",
        "object_tracking": "tactile_records.runs.object_tracking:REPORT",
        "pushing": "tactile_records.runs.pushing:REPORT",
        "trajectory": "tactile_records.runs.trajectory:REPORT",
    },
    Contract(None, base=lambda: TaskReport),
)


def report_of(task: str) -> TaskReport:
    """The report of a task."""
    return REPORTS.load(task if task in REPORTS.names() else "trajectory")


def write_reports(run: Run, folder: Path) -> dict[str, dict[str, Any]]:
    """Write report.json and pictures of each arm, into the folder or with several arms into one each in it.

    Returns
    -------
    dict
        The numbers of each arm; NaN is None, as it is null in the file.

    Raises
    ------
    OSError
        Naming the folder, which cannot be written.
    """
    values = {}
    for arm, place in places(run, folder).items():
        try:
            place.mkdir(parents=True, exist_ok=True)
            values[arm] = write_numbers(run, arm, place / "report.json")
            write_pictures(run, arm, place)
        except OSError as error:  # a full disk comes without a name
            raise OSError(error.errno, error.strerror, str(place)) from error
    return values


def places(run: Run, folder: Path) -> dict[str, Path]:
    """Where each arm's files go."""
    return {arm: folder / arm if len(run) > 1 else folder for arm in run}


def write_numbers(run: Run, arm: str, path: Path) -> dict[str, Any]:
    """Write one arm's numbers, with its settings and its origin (`RunRecord`), and return the numbers."""
    record = run[arm]
    values: dict[str, Any] = metrics.without_nan(report_of(record.task).numbers(record, run))
    kept = {"settings": record.settings, "origin": record.origin}
    path.write_text(json.dumps(values | kept, indent=2) + "\n")
    return values


def write_pictures(run: Run, arm: str, folder: Path) -> list[Path]:
    """Draw one arm's pictures; returns their paths."""
    from tactile_records.runs.figures import draw_all  # matplotlib takes a second to load

    return draw_all(report_of(run[arm].task).pictures, run, arm, folder)


def summary(run: Run, values: Mapping[str, dict[str, Any]]) -> list[tuple[str, str, str]]:
    """What a person wants to see first, of all arms: (name, value with unit, requirement)."""
    rows = []
    for arm, numbers in values.items():
        for name, value, requirement in report_of(run[arm].task).summary(numbers):
            rows.append((f"{arm}: {name}" if len(run) > 1 else name, value, requirement))
    return rows
