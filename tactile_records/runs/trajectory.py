"""An arm that feels nothing: how closely it followed its trajectory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tactile_records.runs import metrics
from tactile_records.runs.figures import of_one_arm, twists
from tactile_records.runs.metrics import arc_length, largest, rms, task_row, text
from tactile_records.runs.record import RunRecord
from tactile_records.runs.report import Run, TaskReport

FIELDS = {
    **metrics.HEAD_FIELDS,
    "path_length_mm": "way of the controlled frame's origin",
    "error_rms_mm": "RMS distance from the trajectory",
    "error_max_mm": "its largest",
    "error_rms_deg": "RMS angle to the trajectory's orientation",
}


def numbers(record: RunRecord, run: Run) -> dict[str, Any]:
    """All numbers of the arm."""
    command = record.command
    error = command.error[np.isfinite(command.error).all(axis=1)]
    distance, angle = np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(error[:, 3:], axis=1)
    return {
        **metrics.head(record),
        "path_length_mm": arc_length(record.pose.T_base_sensor) * 1e3,
        "error_rms_mm": rms(distance * 1e3),
        "error_max_mm": largest(distance * 1e3),
        "error_rms_deg": rms(np.degrees(angle)),
    }


def summary(values: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """What a person wants to see first."""
    return [
        task_row(values),
        ("path length", text(values["path_length_mm"], "mm", 1), ""),
        ("distance from trajectory RMS", text(values["error_rms_mm"], "mm", 3), ""),
    ]


REPORT = TaskReport(
    fields=FIELDS, numbers=numbers, summary=summary, pictures={"twists.png": of_one_arm(twists)}
)
