"""What the runs of a sweep are to be, and their results.

Those are kept until all of them are there: the same command goes on after an end.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tactile_base.whole_file import whole_file
from tactile_filter.bayes_filter import FilterSettings
from tactile_records.replay.report import RunResult
from tactile_records.replay.run import Agreement
from tactile_records.runs.record import BeliefSeries, columns, from_columns

FOLDER = ".runs"


@dataclass(frozen=True)
class Plan:
    """One run: its name, the bag that it writes, and the settings of each arm's filter.

    `given` are the names of settings that do not follow the changes in the recording.
    """

    name: str
    bag: Path
    settings: Mapping[str, FilterSettings]
    given: frozenset[str] = frozenset()


class KeptRuns:
    """A file for each run that is done, in a folder beside the bags.

    Parameters
    ----------
    folder : of all results
    same : what has to agree, beside a run's settings, for its results to count
    """

    def __init__(self, folder: Path, same: Mapping[str, Any]) -> None:
        self._folder, self._same = folder / FOLDER, dict(same)

    def results(self, plan: Plan) -> list[RunResult] | None:
        """Those of a run, of all arms; None if it is not done, was of something else, or has no bag now."""
        try:
            with np.load(self._file(plan)) as file:
                arrays = dict(file)
            plain = json.loads(str(arrays["plain"]))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None
        if plain["of"] != self._of(plan) or not plan.bag.exists():
            return None
        found = []
        for number, values in enumerate(plain["results"]):
            values["beliefs"] = from_columns(BeliefSeries, str(number), arrays)
            values["agreement"] = values["agreement"] and Agreement(**values["agreement"])
            found.append(RunResult(**values))
        return found

    def keep(self, plan: Plan, results: list[RunResult]) -> None:
        """Those of a run whose bag is written."""
        arrays: dict[str, Any] = {}
        plain = []
        for number, result in enumerate(results):
            arrays |= columns(str(number), result.beliefs)
            plain.append(dataclasses.asdict(dataclasses.replace(result, beliefs=BeliefSeries())))
            del plain[-1]["beliefs"]
        arrays["plain"] = np.array(json.dumps({"of": self._of(plan), "results": plain}))
        self._folder.mkdir(parents=True, exist_ok=True)
        with whole_file(self._file(plan)) as temporary, temporary.open("wb") as stream:
            np.savez(stream, **arrays)

    def remove(self) -> None:
        """When all of them are there."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _file(self, plan: Plan) -> Path:
        return self._folder / f"{plan.bag.name}.npz"

    def _of(self, plan: Plan) -> Any:
        """What the results are of, as JSON gives it back."""
        settings = {arm: dataclasses.asdict(each) for arm, each in plan.settings.items()}
        return json.loads(json.dumps([self._same, plan.name, settings, sorted(plan.given)]))
