"""The closed loop without ROS: cell, perception, filters and tasks in one process, as fast as it goes.

The same libraries as the nodes use, in the order in which the graph would call them, for all arms of a scene
on the cell's own clock. What the pipeline would take is simulated: a controller acts on an exposure `latency`
seconds after it. The same scene, task, options and seed give the same bits::

    record = run_offline("ramp", "surface_following", OfflineOptions(fidelity="ideal", seed=1))
    values = surface_following.report(record)
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable

from tactile_base.raised import raised_in_plugin, told
from tactile_base.settings import SettingError
from tactile_base.stamps import NANOSECOND, SECOND_NS
from tactile_bringup.offline_arm import START_NS, Log, OfflineArm, OfflineOptions
from tactile_bringup.offline_perception import perception
from tactile_bringup.run_sequence import RunSequence, arm_plans
from tactile_control.phases import Command
from tactile_control.task_file import Task, load_task, task_path
from tactile_records.runs.log import RunLog
from tactile_records.runs.record import RunRecord
from tactile_scene.scene import Scene
from tactile_scene.scene_file import load_scene
from tactile_sim.cell import Cell

__all__ = ["Log", "OfflineOptions", "run_arms_offline", "run_offline"]

Progress = Callable[[str, str, Command], None]


def run_offline(
    scene: Scene | str,
    task: Task | str = "surface_following",
    options: OfflineOptions | None = None,
    progress: Progress | None = None,
) -> RunRecord:
    """Run a task in which one arm has a role, and return what happened (see `run_arms_offline`).

    Raises `SettingError` also where several arms have a role and the options do not say which.
    """
    records = run_arms_offline(scene, task, options, progress)
    if len(records) > 1:
        raise SettingError(f"several arms have a role: {', '.join(records)}; choose one with --arm")
    return next(iter(records.values()))


def run_arms_offline(
    scene: Scene | str,
    task: Task | str = "surface_following",
    options: OfflineOptions | None = None,
    progress: Progress | None = None,
    log: Log = RunLog,
) -> dict[str, RunRecord]:
    """Run all goals of a task on a scene and return what happened to each arm.

    `SettingError` or `FileNotFoundError` for scenes, tasks, arms and goals that are not there or are wrong.

    Parameters
    ----------
    scene, task : loaded, or by name (config/scenes, config/tasks)
    progress : called with arm, goal and command after each step of a controller
    log : makes the log of each arm, as `OfflineBag.log` does
    """
    options = options or OfflineOptions()
    scene = load_scene(scene) if isinstance(scene, str) else scene
    if options.fidelity is not None:
        scene = scene.with_fidelity(options.fidelity, **options.sensor)
    task = load_task(task_path(task), scene.name, goals_of=scene.goals_of) if isinstance(task, str) else task
    return _OfflineLoop(scene, task, options, progress, log).run()


class _OfflineLoop:
    """The cell and all arms with a role, on the cell's clock."""

    def __init__(
        self, scene: Scene, task: Task, options: OfflineOptions, progress: Progress | None, log: Log
    ) -> None:
        self.options, self.progress = options, progress
        plans = arm_plans(task, scene, options.arm, options.goals)
        if not any(goal.goal.ends for plan in plans for goal in plan.goals):
            arms = ", ".join(f"{plan.arm} ({plan.role.task})" for plan in plans)
            raise SettingError(
                f"task {task.name}: nothing ends this run: {arms} would go on for ever. Run the arm that "
                "leads as well, or give a goal a duration"
            )
        self.sequence = RunSequence(plans)
        seeing = {plan.arm: perception(scene, plan.arm, options.model) for plan in plans}
        views = {arm: view for arm, (_, view) in seeing.items() if view is not None}
        self.cell = Cell(scene, options.seed, START_NS, views)
        self.arms = {
            plan.arm: OfflineArm(scene, task.name, plan, self.cell, options, number, seeing[plan.arm][0], log)
            for number, plan in enumerate(plans)
        }
        for name, arm in self.arms.items():
            arm.partners = self.sequence.partners(name)
        self.work_ns: int | None = None  # since when all arms are at their work

    def run(self) -> dict[str, RunRecord]:
        started, broken, trace = time.perf_counter(), "", ""
        try:
            self._run_goals()
            self._see_aftermath()
        except Exception as error:
            if not raised_in_plugin(error):
                raise
            broken, trace = told(error), traceback.format_exc()
        wall_s = time.perf_counter() - started
        failure = broken or self.sequence.failure
        return {
            name: arm.log.finish(not failure, failure, wall_s, arm.refused, trace or arm.traceback)
            for name, arm in self.arms.items()
        }

    def _run_goals(self) -> None:
        while not self.sequence.finished:
            for plan, goal in self.sequence.start():
                self.arms[plan.arm].begin(goal)
            for arm in self.sequence.finish():
                self.arms[arm].end(self.sequence.failure)
            while not self._tick():
                pass

    def _see_aftermath(self) -> None:
        """What comes of a lie after the run, when nobody commands any more."""
        lies = self.options.lies
        for _ in range(round(lies.aftermath * self.cell.scene.simulation.rate) if lies is not None else 0):
            self._tick()

    def _tick(self) -> bool:
        """One step of the cell: what the arms report, then what has become due, then new exposures.

        Returns whether that was news for the order of the run: a phase begun, a goal ended.
        """
        news = False
        for arm in self.arms.values():
            arm.take_pose()
        now_ns = self.cell.step()
        if self.options.lies is not None:
            self.options.lies.see(self.cell)
        for name, arm in self.arms.items():
            command = arm.control(now_ns)
            if command is None:
                continue
            news |= self.sequence.phase(name, command.phase)
            for other in self.arms.values():
                other.partners.hear(name, now_ns * NANOSECOND, command)
            if self.progress is not None:
                self.progress(name, arm.goal_name, command)
            late = arm.over_time(now_ns)
            if command.done or late:
                arm.task, news = None, True
                well = command.done and command.succeeded
                self.sequence.result(name, well, command.reason or arm.late)
        for arm in self.arms.values():
            arm.expose()
        return self._worked_enough(now_ns) or news

    def _worked_enough(self, now_ns: int) -> bool:
        """Whether `work_time` is over now, which ends the run."""
        if self.work_ns is None and self.sequence.at_work:
            self.work_ns = now_ns
        if self.sequence.ended or self.work_ns is None:
            return False
        self.sequence.ended = now_ns - self.work_ns >= self.options.work_time * SECOND_NS
        return self.sequence.ended
