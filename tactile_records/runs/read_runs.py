"""Runs of all arms from where they were kept: a recording, or what `tactile simulate` wrote."""

from __future__ import annotations

from pathlib import Path

from tactile_records.runs.from_bag import read_arms
from tactile_records.runs.record import RunRecord

RECORD = "run.npz"


def read_runs(source: Path) -> dict[str, RunRecord]:
    """Records by arm, of a bag, a run.npz, or a folder with one of an arm or of each.

    `BagError` or `ValueError` where it is none of them, or damaged.
    """
    if source.suffix == ".npz":
        files = [source]
    else:
        files = [source / RECORD] if (source / RECORD).exists() else sorted(source.glob(f"*/{RECORD}"))
    if not files:
        return read_arms(source)
    records = map(RunRecord.load, files)
    return {record.arm: record for record in records}
