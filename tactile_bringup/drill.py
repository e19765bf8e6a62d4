"""Drill: a task on a simulated scene in which one thing at a time does not tell the truth.

Nothing of the task, the filter and the safe command stage knows of it (`tactile_doubles.lies`);
what it leads to is told by the cell's truth. A drill is passed where the arms come to rest in time and no
tip goes deeper than allowed, or where the task ends as an honest one does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from tactile_base.settings import SettingError
from tactile_base.stamps import SECOND_NS
from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_control.task_file import Task
from tactile_doubles.lies import Lies
from tactile_doubles.lying_arm import ARM_LIES, LyingArm
from tactile_doubles.lying_camera import LYING_CAMERAS, ImageLies
from tactile_doubles.lying_estimates import LYING_ESTIMATES
from tactile_records.runs.record import RunRecord
from tactile_scene.scene import Scene

#: From when it begins (s of the cell's clock) and whom it is about, what does not tell the truth.
Fault = Callable[[float, str], Lies]

DEEPEST = 0.006  # m: twice what tasks ask for, far from the depth at which the simulated tip gives up
OFF = 0.005  # m, between the ends of a run that ended well all the same and of the honest one
AFTERWARDS = 30.0  # s at work after a fault has begun: a drift of 1 mm/s is through with any depth by then
#: What no software stops: an arm that does as it likes. It has to be told.
UNSTOPPABLE = ("arm: ignores_stop", "arm: moves_by_itself")


def faults(images: bool) -> dict[str, Fault]:
    """All faults by name; those of cameras where sensors have `images`."""

    def of_arm(name: str) -> Fault:
        return lambda begins, arm: LyingArm(name, begins, arm)

    def of_camera(name: str) -> Fault:
        return lambda begins, arm: ImageLies(name, begins, arm)

    found: dict[str, Fault] = {f"arm: {name}": of_arm(name) for name in ARM_LIES}
    if images:
        found |= {f"camera: {name}": of_camera(name) for name in LYING_CAMERAS}
    return found | {f"estimates: {name}": make for name, make in LYING_ESTIMATES.items()}


@dataclass(frozen=True)
class Outcome:
    """What came of one fault of one arm; over all arms of the task, the worst.

    Attributes
    ----------
    fault, arm : what went wrong, and whose; empty: all arms'
    known, rest : from its beginning until a task stopped or failed, and until all arms were at rest for good,
        s; inf: never
    fastest : largest speed of a controlled frame since then, m/s
    way, deepest, deeper : float
        Of the tip since then, m: its path, its depth, and how much more that is than before.
    off : how far from the end of the honest run this one ended, m; inf where it did not end well
    reason : what the user reads; empty where the task ended well
    """

    fault: str
    arm: str
    known: float
    rest: float
    fastest: float
    way: float
    deepest: float
    deeper: float
    off: float
    reason: str

    def objection(self, deepest: float = DEEPEST) -> str:
        """Why the drill is not passed; empty where it is."""
        if self.deepest > deepest and self.fault not in UNSTOPPABLE:
            return f"{1e3 * self.deepest:.1f} mm deep, must stay below {1e3 * deepest:g}"
        if not self.reason:
            return f"done, {1e3 * self.off:.1f} mm off" if self.off > OFF else ""
        return "does not rest" if math.isinf(self.rest) and self.fault not in UNSTOPPABLE else ""


@dataclass(frozen=True)
class Drill:
    """A task, where it is drilled, and when faults begin; runs end `AFTERWARDS` after that, if not before.

    Attributes
    ----------
    after : how long the task has been at its own work, s; None: from the very beginning
    """

    scene: Scene
    task: Task
    options: OfflineOptions
    after: float | None = 3.0

    def run(self, chosen: Mapping[str, Fault], arms: tuple[str, ...] = ()) -> Iterator[Outcome]:
        """The outcome of each fault, of each of these arms in turn; of all at once where none is named.

        Raises `SettingError` if the task does not end well where nothing goes wrong.
        """
        truth = Lies()
        honest = self._records(truth)
        for name, record in honest.items():
            if not record.result["succeeded"]:
                raise SettingError(f"{name}: fails though nothing goes wrong: {record.result['reason']}")
        for fault, make in chosen.items():
            for arm in [arm for arm in arms if arm in honest] or ("",):
                lies = make(0.0 if self.after is None else self._begins(honest, arm) + self.after, arm)
                records = self._records(lies)
                ends = [truth.witness[name].position - lies.witness[name].position for name in records]
                off = float(
                    np.nanmax(np.linalg.norm(ends, axis=1))
                )  # of an arm without a sensor nobody knows
                yield _outcome(fault, arm, lies, records, off)

    def _records(self, lies: Lies) -> dict[str, RunRecord]:
        work_time = (self.after or 0.0) + AFTERWARDS
        return run_arms_offline(self.scene, self.task, replace(self.options, lies=lies, work_time=work_time))

    def _begins(self, honest: Mapping[str, RunRecord], arm: str) -> float:
        """When the arm's task came to its own work, s of the cell's clock; of all arms, the last."""
        starts = []
        for name, record in honest.items():
            if arm in ("", name):
                starts.append(int(record.command.stamp_ns[record.command.phase == record.work][0]))
        return max(starts) / SECOND_NS


def _outcome(fault: str, arm: str, lies: Lies, records: Mapping[str, RunRecord], off: float) -> Outcome:
    begins_ns = lies.begins_ns
    seen = [lies.witness[name] for name in records]
    known = min(_stopped(record, begins_ns) for record in records.values())
    before, deepest = zip(*(_depths(record, begins_ns) for record in records.values()), strict=True)
    reasons = [f"{name}: {r.result['reason']}" for name, r in records.items() if not r.result["succeeded"]]
    return Outcome(
        fault,
        arm,
        known,
        max(one.rests_since for one in seen),
        max(one.fastest for one in seen),
        max(one.way for one in seen),
        max(one.deepest for one in seen),
        max(np.subtract(deepest, before)),
        math.inf if reasons else off,
        reasons[0].removeprefix(f"{arm}: ") if reasons else "",
    )


def _stopped(record: RunRecord, begins_ns: int) -> float:
    """When the task first stopped or failed, s since then."""
    command = record.command
    found = (command.stamp_ns >= begins_ns) & np.isin(command.phase, ("stopping", "failed"))
    return float(command.stamp_ns[found][0] - begins_ns) / SECOND_NS if found.any() else math.inf


def _depths(record: RunRecord, begins_ns: int) -> tuple[float, float]:
    """The deepest before, while at work, and since then, m; 0 off the surface."""
    if not len(record.truth):
        return 0.0, 0.0
    depth, stamp_ns = record.truth.T_fs[:, 2, 3], record.truth.stamp_ns
    before = (stamp_ns < begins_ns) & record.working(stamp_ns)
    return float(depth[before].max(initial=0.0)), float(depth[stamp_ns >= begins_ns].max(initial=0.0))
