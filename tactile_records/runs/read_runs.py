"""Runs of all arms from where they were kept: a recording, or what `tactile simulate` wrote."""

from __future__ import annotations

from pathlib import Path

from tactile_records.runs.from_bag import read_arms
from tactile_records.runs.record import RunRecord

RECORD = "run.npz"


def of_arms(folder: Path, name: str) -> list[Path]:
    """The files of that name in a folder of results: of one arm, or in a folder of each of several."""
    return [folder / name] if (folder / name).exists() else sorted(folder.glob(f"*/{name}"))


def read_runs(source: Path) -> dict[str, RunRecord]:
    """Records by arm, of a bag, a run.npz, or a folder with one of an arm or of each.

    `BagError` or `ValueError` where it is none of them, or damaged.
    """
    files = [source] if source.suffix == ".npz" else of_arms(source, RECORD)
    if not files:
        return read_arms(source)
    records = map(RunRecord.load, files)
    return {record.arm: record for record in records}
