"""Many trials: each done once and kept as a row of a file, in processes here or on a Dask cluster's machines.

A trial is any value that can be sent to another process; what it is called (`name`) tells it from the others,
and what work makes of it is a row, a mapping that JSON can hold::

    rows = TrialRows(folder / "trials.jsonl")
    for row in run_trials(work, rows.missing(trials), processes=4):
        rows.add(row)
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Protocol, TypeVar

from tactile_base.cluster import cluster_client
from tactile_base.input_file import parse_json

Row = dict[str, Any]


class Named(Protocol):
    """A trial."""

    @property
    def name(self) -> str:
        """What tells it from the others."""


T = TypeVar("T", bound=Named)


class TrialRows:
    """The rows of the trials that are done, in a file with one JSON object a line.

    A row is written whole, at once: an interruption costs the trials under way. A last line that ends early,
    as where the power failed, is cut off.

    Raises
    ------
    ValueError
        If a line of the file is no row, with its number.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._rows = {row["name"]: row for row in self._read()}

    def __len__(self) -> int:
        return len(self._rows)

    def missing(self, trials: Sequence[T]) -> list[T]:
        """Those that are not done yet."""
        return [trial for trial in trials if trial.name not in self._rows]

    def of(self, trials: Sequence[Named]) -> list[Row]:
        """The rows of those that are done, in their order."""
        return [self._rows[trial.name] for trial in trials if trial.name in self._rows]

    def add(self, row: Row) -> None:
        """Keep a row."""
        line = json.dumps(row).encode() + b"\n"
        file = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            if os.write(file, line) < len(line):
                raise OSError(28, "No space left on device", str(self.path))
        finally:
            os.close(file)
        self._rows[row["name"]] = row

    def _read(self) -> Iterator[Row]:
        if not self.path.exists():
            return
        *lines, rest = self.path.read_bytes().split(b"\n")
        if rest:
            os.truncate(self.path, self.path.stat().st_size - len(rest))
        for number, line in enumerate(lines, start=1):
            try:
                row = parse_json(line.decode())
                if not isinstance(row, dict) or not isinstance(row.get("name"), str):
                    raise ValueError("it has no name")
            except ValueError as error:
                raise ValueError(
                    f"{self.path}:{number}: is no trial ({error}); remove the line or the file"
                ) from error
            yield row


def run_trials(
    work: Callable[[T], Row], trials: Sequence[T], processes: int = 1, scheduler: str = ""
) -> Iterator[Row]:
    """Rows as they come, of so many processes or of the workers of a Dask scheduler.

    On a cluster the project has to be installed on every machine. Leaving the iterator ends what is waiting.
    """
    if scheduler:
        yield from _on_cluster(work, trials, scheduler)
    elif processes == 1:
        yield from map(work, trials)
    else:
        with ProcessPoolExecutor(min(processes, max(1, len(trials))), get_context("spawn")) as pool:
            futures = [pool.submit(work, trial) for trial in trials]
            try:
                for future in as_completed(futures):
                    yield future.result()
            finally:
                pool.shutdown(wait=False, cancel_futures=True)


def _on_cluster(work: Callable[[T], Row], trials: Sequence[T], scheduler: str) -> Iterator[Row]:
    with cluster_client(scheduler) as client:
        from distributed import as_completed as as_done

        for future in as_done([client.submit(work, trial, pure=False) for trial in trials]):
            yield future.result()
