"""An arm that feels nothing: how closely it followed its trajectory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tactile_records.runs.figures import of_one_arm, twists
from tactile_records.runs.metrics import arc_length, duration, largest, rms, text
from tactile_records.runs.record import RunRecord
from tactile_records.runs.report import Run, TaskReport

FIELDS = {
    "scene": "name of the scene",
    "task": "name of the task",
    "task_file": "name of the task file",
    "role": "what the arm does in it",
    "arm": "name of the arm",
    "source": "offline (loop in one process) or ros (nodes)",
    "seed": "seed of the simulated cell",
    "succeeded": "the run did all that it was asked to",
    "reason": "why it failed, in words; empty where it did not",
    "duration_s": "from the first command to the last",
    "path_length_mm": "way of the controlled frame's origin",
    "error_rms_mm": "RMS distance from the trajectory",
    "error_max_mm": "its largest",
    "error_rms_deg": "RMS angle to the trajectory's orientation",
    "wall_s": "wall-clock time of the run",
}


def numbers(record: RunRecord, run: Run) -> dict[str, Any]:
    """All numbers of the arm."""
    command = record.command
    error = command.error[np.isfinite(command.error).all(axis=1)]
    distance, angle = np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(error[:, 3:], axis=1)
    return {
        "scene": record.scene,
        "task": record.task,
        "task_file": record.task_file,
        "role": record.role,
        "arm": record.arm,
        "source": record.source,
        "seed": record.seed,
        "succeeded": bool(record.result.get("succeeded", False)),
        "reason": str(record.result.get("reason", "")),
        "duration_s": duration(command.stamp_ns),
        "path_length_mm": arc_length(record.pose.T_base_sensor) * 1e3,
        "error_rms_mm": rms(distance * 1e3),
        "error_max_mm": largest(distance * 1e3),
        "error_rms_deg": rms(np.degrees(angle)),
        "wall_s": record.result.get("wall_s"),
    }


def summary(values: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """What a person wants to see first."""
    return [
        ("task", "succeeded" if values["succeeded"] else f"failed: {values['reason']}", ""),
        ("path length", text(values["path_length_mm"], "mm", 1), ""),
        ("distance from trajectory RMS", text(values["error_rms_mm"], "mm", 3), ""),
    ]


REPORT = TaskReport(
    fields=FIELDS, numbers=numbers, summary=summary, pictures={"twists.png": of_one_arm(twists)}
)
