"""An arm of a scene that touches a surface for a calibration: over the graph, or simulated in one process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tactile_bringup.offline import OfflineOptions, run_offline
from tactile_control.task_file import NamedGoal, Role, Task
from tactile_control.tasks.touching import TouchingGoal, TouchingTaskSettings
from tactile_records.bags.reader import read_bag
from tactile_records.runs.from_bag import run_from_bag
from tactile_records.runs.record import RunRecord
from tactile_scene.scene import Scene

TASK = "touching"
#: What each calibration has the arm do.
GOALS = {
    "time": TouchingGoal(swing=(0.0, 0.0, 0.0015, 0.0, 0.0, 0.0), period=1.0, periods=15),
    "tip": TouchingGoal(upright=3, tilted=8, tilt_deg=30.0, depth=0.001, rest=0.1),
    "mounting": TouchingGoal(
        upright=3,
        tilted=8,
        tilt_deg=16.0,
        depth=0.003,
        rest=0.3,
        swing=(0.0015, 0.0015, 0.0, 0.0, 0.0, 0.0),
        period=1.0,
        periods=1,
    ),
}


def task_of(scene: Scene, arm: str, what: str, **changes: Any) -> Task:
    """The task by which an arm moves for a calibration of `GOALS`, with changes of its goal by name."""
    settings = TouchingTaskSettings().replaced(
        task__press_speed=0.002, watchdog__patience=5.0, watchdog__start_timeout=10.0
    )
    goals = (NamedGoal(what, GOALS[what].replaced(**changes)),)
    return Task(f"cell_{what}", scene.name, (Role("toucher", TASK, settings, goals, arms=(arm,)),))


def simulated(scene: Scene, arm: str, what: str, seed: int = 0, **changes: Any) -> RunRecord:
    """The run of a simulated arm, in this process."""
    return run_offline(scene, task_of(scene, arm, what, **changes), OfflineOptions(seed=seed))


def recorded(path: Path, arm: str) -> RunRecord:
    """The run of an arm from a bag, or from the record (run.npz) that `tactile simulate` keeps."""
    return RunRecord.load(path) if path.suffix == ".npz" else run_from_bag(read_bag(path), arm)
