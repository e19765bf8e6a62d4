"""Trials of pushing side by side in the plane: the fidelity `plane` of an experiment.

What a trial draws, its scene, task and settings are those of the other fidelities (`pushing.setup_of`); cell,
filter and tasks are in arrays, one number for each trial. A row is that of the loop without ROS as far as the
plane knows it::

    common = Common("single", fidelity=PLANE)
    rows = plane_rows(Batch(tuple(Trial(common, "blue_square", "mdf", seed) for seed in range(100))))
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np

from tactile_base.array_math import ArrayMath, array_math
from tactile_base.jobs import Row
from tactile_base.settings import SettingError
from tactile_bringup.experiments.pushing import Trial, setup_of
from tactile_bringup.experiments.pushing_variations import Setup, drawn
from tactile_bringup.run_sequence import ArmPlan, arm_plans
from tactile_control.plane_tasks import REASONS, PlaneContactTask, PlanePushing, PlaneTracking, Told
from tactile_control.tasks.object_tracking import ObjectTracking
from tactile_control.tasks.pushing import Pushing
from tactile_filter.plane_filter import PlaneBelief, PlaneFilter
from tactile_records.runs.metrics import without_nan
from tactile_scene.scene import Scene
from tactile_sim.plane_body import cross
from tactile_sim.plane_cell import PlaneCell, Seen

Array = Any  # of the library in use

SIDE_BY_SIDE = 400  # trials in one job: more gain little
NOT_IN_TIME = REASONS.index("the push was not done in time")
FOLLOWER_FAILED = REASONS.index("the follower failed")
TILTS = FOLLOWER_FAILED + 1


@dataclass(frozen=True)
class Batch:
    """Trials that run side by side."""

    trials: tuple[Trial, ...]
    device: str = "numpy"

    @property
    def name(self) -> str:
        """What it is called where it fails."""
        return f"{self.trials[0].name} to {self.trials[-1].name}"


def batches(trials: Sequence[Trial], device: str = "numpy", at_once: int = SIDE_BY_SIDE) -> list[Batch]:
    """The trials in as many as run side by side, those of a table apart."""
    return [
        Batch(tuple(same[k : k + at_once]), device)
        for common in dict.fromkeys(trial.common for trial in trials)
        for same in [[trial for trial in trials if trial.common == common]]
        for k in range(0, len(same), at_once)
    ]


def plane_rows(batch: Batch) -> list[Row]:
    """The rows of a batch's trials; `SettingError` for what the plane cannot do or `device` does not have."""
    math, rows = array_math(batch.device), {}
    groups: dict[Any, list[tuple[Trial, Setup, Scene]]] = {}
    for trial in batch.trials:
        setup = setup_of(trial)
        scene = setup.pushing_scene()
        rates = tuple(arm.sensor.settings.camera_rate for arm in scene.arms.values() if arm.sensor)
        groups.setdefault((setup.options.latency, setup.options.filter, rates), []).append(
            (trial, setup, scene)
        )
    for group in groups.values():
        trials, setups, scenes = zip(*group, strict=True)
        started = time.perf_counter()
        pushes = _Pushes(setups[0], scenes, [setup.options.seed for setup in setups], math)
        found, other = pushes.run(), pushes.follower.plan.arm if pushes.follower else None
        wall_s = (time.perf_counter() - started) / len(group)
        for k, (trial, scene) in enumerate(zip(trials, scenes, strict=True)):
            numbers = {name: values[k].item() for name, values in found.items()} | {"follower": other}
            rows[trial.name] = _row(trial, scene, numbers, wall_s)
    return [rows[trial.name] for trial in batch.trials]


def _row(trial: Trial, scene: Scene, numbers: dict[str, Any], wall_s: float) -> Row:
    reason = REASONS[int(numbers.pop("reason"))]
    followed = numbers["follower_contact_fraction"]
    return dict(
        without_nan(
            {
                "name": trial.name,
                "object": trial.object,
                "floor": trial.floor,
                "trial": trial.number,
                "varied": dict(trial.varied),
                **drawn(scene),
                "succeeded": not reason,
                "reason": reason,
                "contact_lost": min(numbers["contact_fraction"], np.nan_to_num(followed, nan=1.0)) < 1.0,
                **numbers,
                "direction_error_deg": None,
                "body_tilt_max_deg": None,
                "wall_s": wall_s,
            }
        )
    )


class _Pushes:
    """One run of N trials."""

    def __init__(self, setup: Setup, scenes: Sequence[Scene], seeds: Sequence[int], math: ArrayMath) -> None:
        self.math, self.options, scene = math, setup.options, scenes[0]
        self.cell = PlaneCell(scenes, seeds, math)
        rate = scene.simulation.rate
        self.late = max(1, ceil(setup.options.latency * rate - 1e-6))  # ticks from exposure to command
        self.idle = ceil(setup.options.control_period * rate - 1e-6)
        plans = arm_plans(setup.task, scene, setup.options.arm)
        self.arms = [_Arm(plan, list(scene.arms).index(plan.arm), self, setup) for plan in plans]
        pushers = [arm for arm in self.arms if isinstance(arm.task, PlanePushing)]
        if len(pushers) != 1 or len(self.arms) > 2:
            raise SettingError("fidelity plane: one arm has to push, and one other may follow")
        self.pusher = pushers[0]
        self.follower = next((arm for arm in self.arms if arm is not self.pusher), None)
        self.numbers = _Numbers(self)

    def run(self) -> dict[str, Any]:
        """Push all, and what came of it, (N,) each."""
        pusher, cell = self.pusher.task, self.cell
        yes = pusher.over | ~pusher.over
        while cell.ticks * cell.dt < self.options.time_limit and not bool(pusher.over.all()):
            cell.step()
            for arm in self.arms:
                waits = arm.plan.role.after is not None and self.follower is not None
                arm.control(self.follower.task.working if waits and self.follower else yes)
            pusher.fail(cell.bodies.tilts, TILTS)
            if self.follower is not None:
                pusher.fail(self.follower.task.over, FOLLOWER_FAILED)
            for arm in self.arms:
                if cell.exposure_due(arm.index):
                    arm.expose()
            if cell.exposure_due(self.pusher.index):
                self.numbers.add()
        return self.numbers.found()


class _Arm:
    """N arms with a role."""

    def __init__(self, plan: ArmPlan, index: int, run: _Pushes, setup: Setup) -> None:
        self.plan, self.index, self.run = plan, index, run
        settings: Any = plan.role.settings
        count, math = len(run.cell.sensors[index].sigma.T), run.math
        self.task: PlaneContactTask
        if plan.role.task_type is Pushing:
            self.task = PlanePushing(settings, _target(plan, setup.scene), count, math)
        elif plan.role.task_type is ObjectTracking:
            self.task = PlaneTracking(settings, count, math)
        else:
            raise SettingError(f"fidelity plane: it knows no task {plan.role.task}")
        self.filter = PlaneFilter(setup.options.filter, run.cell.sensors[index].sigma, math)
        self.seen: Seen | None = None
        self.stated = run.cell.arms[index].pose  # of that exposure, as the arm says
        self.belief: PlaneBelief | None = None
        self._queue: deque[tuple[int, PlaneBelief]] = deque()
        self._stepped = 0

    def control(self, may_begin: Array) -> None:
        """A step of the task, where something has become due or some time has passed."""
        cell, run, news = self.run.cell, self.run, None
        if self._queue and self._queue[0][0] + run.late <= cell.ticks:
            exposed, belief = self._queue.popleft()
            news = exposed * cell.dt, belief
        if news is None and cell.ticks - self._stepped < run.idle:
            return
        self._stepped, arm = cell.ticks, cell.arms[self.index]
        told = Told(arm.told.at, arm.told.turn)
        arm.target = self.task.step(cell.ticks * cell.dt, told, news, may_begin)

    def expose(self) -> None:
        """An exposure through the filter, on its way to the task."""
        self.seen, self.stated = self.run.cell.expose(self.index), self.run.cell.arms[self.index].pose
        self.belief = self.filter.observe(self.seen, self.stated)
        self._queue.append((self.run.cell.ticks, self.belief))


def _target(plan: ArmPlan, scene: Scene) -> complex:
    goals: Any = plan.goals
    if len(goals) != 1 or goals[0].goal.direction:
        raise SettingError("fidelity plane: a push has one goal, without a direction")
    x, y, *_ = scene.arms[plan.arm].T_world_base @ np.append(goals[0].goal.target, 1.0)
    return complex(x, y)


class _Numbers:
    """What is told of pushes: the report's numbers, kept while the pushers are at work."""

    def __init__(self, run: _Pushes) -> None:
        self.run = run
        zero = 0.0 * run.cell.bodies.turn
        none = zero + float("nan")
        self.last = dict.fromkeys(
            ("error_mm", "error_believed_mm", "error_axis_mm", "distance_mm", "body_turned_deg"), none
        )
        self.most = dict.fromkeys(("shear_max_mm", "tip_depth_max_mm"), zero)
        self.sums = dict.fromkeys(("rows", "contact", "slips", "followed", "depth", "way"), zero)
        self.turn: Array | None = None  # of the bodies, as the push began
        self.before: Array | None = None  # where they were at the last exposure

    def add(self) -> None:
        """An exposure of the pushers."""
        run, math = self.run, self.run.math
        task, seen, belief = run.pusher.task, run.pusher.seen, run.pusher.belief
        assert isinstance(task, PlanePushing) and seen is not None and belief is not None
        works = task.working & ~task.over
        touches = works & seen.present
        way = 1e3 * (task.target - seen.pose.at)
        stated = run.pusher.stated
        axis, believed = (math.exp(1j * turn) for turn in (seen.pose.turn, stated.turn + belief.turn))
        bodies = run.cell.bodies
        goes_on = self.sums["rows"] > 0.0
        self.turn = bodies.turn if self.turn is None else math.where(goes_on, self.turn, bodies.turn)
        now = {
            "error_mm": cross(seen.normal, way),
            "error_believed_mm": cross(believed, 1e3 * (task.target - stated.at)),
            "error_axis_mm": cross(axis, way),
            "distance_mm": abs(way),
            "body_turned_deg": np.degrees(1.0) * (bodies.turn - self.turn),
        }
        self.last = {name: math.where(touches, now[name], old) for name, old in self.last.items()}
        deepest = {"shear_max_mm": 1e3 * seen.shear, "tip_depth_max_mm": 1e3 * seen.depth}
        self.most = {
            name: math.where(touches, math.maximum(old, deepest[name]), old)
            for name, old in self.most.items()
        }
        moved = abs(bodies.at - (bodies.at if self.before is None else self.before))
        self._sum("way", math.where(goes_on, moved, 0.0) * works)
        self._sum("rows", works * 1.0)
        self._sum("contact", touches * 1.0)
        self._sum("slips", (touches & seen.slips) * 1.0)
        self.before = bodies.at
        if run.follower is not None and (other := run.follower.seen) is not None:
            depth = run.follower.task.settings.servoing.reference[2]
            self._sum("followed", (works & other.present) * 1.0)
            self._sum("depth", works * (other.depth - depth) ** 2)

    def _sum(self, name: str, value: Array) -> None:
        self.sums[name] = self.sums[name] + value

    def found(self) -> dict[str, Any]:
        """All of it, (N,) of NumPy."""
        run, task = self.run, self.run.pusher.task
        kept = self.last, self.most, self.sums
        last, most, sums = ({name: run.math.numpy(v) for name, v in part.items()} for part in kept)
        rows = np.maximum(sums["rows"], 1.0)
        over, reason = run.math.numpy(task.over), run.math.numpy(task.reason)
        none, follows = np.full(len(rows), np.nan), run.follower is not None
        tilts = run.math.numpy(run.cell.bodies.tilts)
        return {
            "reason": np.where(over, reason, NOT_IN_TIME),
            "contact_fraction": sums["contact"] / rows,
            "slip_fraction": sums["slips"] / rows,
            "work_s": run.math.numpy(task.worked_s),
            "error_abs_mm": abs(last["error_mm"]),
            "error_true_mm": last["error_mm"],
            **last,
            **most,
            "body_way_mm": 1e3 * sums["way"],
            "toppled": tilts,
            "follower_contact_fraction": sums["followed"] / rows if follows else none,
            "follower_depth_rms_mm": 1e3 * np.sqrt(sums["depth"] / rows) if follows else none,
        }
