"""The order of a run: which arm starts which goal when, and when the run is over.

The same for processes over ROS and for the loop without: both say what the arms report, and ask what to do.
Each arm runs its goals one after the other. A role may wait for another one's phase, a follower's contact for
instance; when the arms whose end ends the run are through, or one has failed, the others finish::

    sequence = RunSequence(arm_plans(task, scene))
    while not sequence.finished:
        for plan, goal in sequence.start():
            send(plan.arm, goal)
        for arm in sequence.finish():
            ask_to_finish(arm)
        ...                                 # sequence.phase(arm, name), sequence.result(arm, success, reason)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import SettingError
from tactile_control.partners import Partners
from tactile_control.phases import FAILED, STOPPING
from tactile_control.task_file import NamedGoal, Role, Task
from tactile_scene.scene import ArmScene, Scene


@dataclass(frozen=True)
class ArmPlan:
    """What one arm does in a run: its role, and its goals with where each begins."""

    arm: str
    role: Role
    goals: tuple[NamedGoal, ...]

    @property
    def targets(self) -> NDArray[np.float64]:
        """The position in the base (G, 3) that each goal is to reach, m; NaN for one that has none."""
        return self._of_goals("target")

    @property
    def directions(self) -> NDArray[np.float64]:
        """The direction in the base (G, 3) in which each goal is to end; NaN for one that has none."""
        return self._of_goals("direction")

    def _of_goals(self, name: str) -> NDArray[np.float64]:
        given = [getattr(goal.goal, name, ()) or (np.nan,) * 3 for goal in self.goals]
        return np.array(given, dtype=float)


def awaited_by(plan: ArmPlan, plans: Sequence[ArmPlan]) -> list[str]:
    """The arms whose work one waits for before it begins (`Role.after`)."""
    role = plan.role.after[0] if plan.role.after else ""
    return [other.arm for other in plans if other.role.name == role]


def waiting_for(plan: ArmPlan, plans: Sequence[ArmPlan]) -> list[str]:
    """The arms that wait for the work of one."""
    return [other.arm for other in plans if plan.arm in awaited_by(other, plans)]


def arm_plans(task: Task, scene: Scene, only: str | None = None, goals: Sequence[str] = ()) -> list[ArmPlan]:
    """What each arm of the scene does.

    `SettingError` if a role names an arm that is not there or cannot run its task, two roles have the same
    arm, or nothing is left to do.

    Parameters
    ----------
    only : leave out all arms but this one
    goals : leave out all goals but these, in roles that have any of them
    """
    plans: dict[str, ArmPlan] = {}
    for role in task.roles:
        for arm in _arms_of(role, scene):
            if arm in plans:
                raise SettingError(
                    f"task {task.name}: arm '{arm}' has two roles, {plans[arm].role.name} and {role.name}"
                )
            plans[arm] = ArmPlan(arm, role, _begun(role, scene.arms[arm]))
    known = {goal.name for plan in plans.values() for goal in plan.goals}
    if unknown := [name for name in goals if name not in known]:
        raise SettingError(f"goal '{unknown[0]}' does not exist; valid: {', '.join(sorted(known))}")
    chosen = [_only_goals(plan, goals) for plan in plans.values() if only is None or plan.arm == only]
    if not chosen:
        where = f"--arm {only}" if only is not None else f"scene {scene.name}"
        raise SettingError(f"task {task.name}: {where}: no arm to run it, of {', '.join(plans) or 'none'}")
    return chosen


def _arms_of(role: Role, scene: Scene) -> list[str]:
    feels = role.task_type.needs_sensor
    able = [name for name, arm in scene.arms.items() if arm.sensor is not None or not feels]
    for arm in role.arms:
        if arm not in able:
            lacks = "has no tactile sensor" if arm in scene.arms else "is not in the scene"
            raise SettingError(
                f"scene {scene.name}, role {role.name}: arm '{arm}' {lacks}; valid: {', '.join(able)}"
            )
    return list(role.arms) or able


def _begun(role: Role, arm: ArmScene) -> tuple[NamedGoal, ...]:
    """The goals in the arm's base, those without a start of their own from where the arm starts.

    Only the first goal of a task that feels nothing has a start: it goes on from where the last one ended.
    """
    begun = []
    for index, goal in enumerate(role.goals):
        returns = goal.start is None and (role.task_type.needs_sensor or index == 0)
        start = arm.T_base_start if returns else goal.start
        placed = dataclasses.replace(goal, goal=goal.goal.in_base(arm.T_world_base), start=start)
        check_places(placed, arm)
        begun.append(placed)
    return tuple(begun)


def check_places(goal: NamedGoal, arm: ArmScene) -> None:
    """Raise `SettingError` for a goal that begins or ends where the arm may not be."""
    places: list[ArrayLike] = [goal.start[:3, 3]] if goal.start is not None else []
    places += [goal.goal.destination] if goal.goal.destination else []
    for place in places:
        if reason := arm.out_of_bounds(place):
            raise SettingError(f"goal '{goal.name}': {reason}")


def _only_goals(plan: ArmPlan, wanted: Sequence[str]) -> ArmPlan:
    goals = tuple(goal for goal in plan.goals if goal.name in wanted)
    return dataclasses.replace(plan, goals=goals) if goals else plan


@dataclass
class _ArmState:
    """How far an arm has come."""

    plan: ArmPlan
    next: int = 0
    running: bool = False
    asked: bool = False
    failing: bool = False
    phases: set[str] = field(default_factory=set)

    @property
    def through(self) -> bool:
        return not self.running and self.next == len(self.plan.goals)


class RunSequence:
    """See the module's text.

    Attributes
    ----------
    failure : why the run failed; '' as long as it has not
    ended : set it to have all arms finish what they do, whatever is left of their goals
    """

    def __init__(self, plans: Sequence[ArmPlan]) -> None:
        self._plans = tuple(plans)
        self._arms = {plan.arm: _ArmState(plan) for plan in plans}
        ending = [state for state in self._arms.values() if state.plan.role.ends_run]
        lasting = [state for state in self._arms.values() if not state.plan.role.task_type.endless]
        self._ending = ending or lasting or list(self._arms.values())
        self.failure = ""
        self.ended = False

    @property
    def over(self) -> bool:
        """Whether no further goal starts."""
        if self.ended or self.failure or any(state.failing for state in self._arms.values()):
            return True
        return all(state.through for state in self._ending)

    @property
    def finished(self) -> bool:
        """Whether all arms are done."""
        return self.over and not any(state.running for state in self._arms.values())

    @property
    def at_work(self) -> bool:
        """Whether every arm has come to the phase in which it does what it is for."""
        return all(state.plan.role.task_type.work in state.phases for state in self._arms.values())

    def running(self, arm: str) -> bool:
        """Whether a goal of the arm is under way."""
        return self._arms[arm].running

    def start(self) -> list[tuple[ArmPlan, int]]:
        """Goals that start now, by their index in the arm's plan; they count as running from here on."""
        begun = []
        for state in [] if self.over else self._arms.values():
            if not state.running and not state.through and self._may_begin(state):
                state.running = True
                begun.append((state.plan, state.next))
        return begun

    def finish(self) -> list[str]:
        """Arms that are to finish what they do since the run is over; each is named once."""
        if not self.over:
            return []
        late = [
            state for state in self._arms.values() if state.running and not (state.asked or state.failing)
        ]
        for state in late:
            state.asked = True
        return [state.plan.arm for state in late]

    def phase(self, arm: str, phase: str) -> bool:
        """Take in the phase that an arm is in; returns whether it is there for the first time.

        One that stops unasked is about to fail. The others need not wait until it has left the surface: what
        they hold together with it they hold alone by then.
        """
        state = self._arms[arm]
        new = phase not in state.phases
        state.phases.add(phase)
        state.failing = state.failing or (phase in (STOPPING, FAILED) and not state.asked)
        return new

    def result(self, arm: str, success: bool, reason: str) -> bool:
        """Take in how an arm's goal ended; returns whether that was well.

        One that was asked to finish, as the run was over, has done what was wanted of it.
        """
        state = self._arms[arm]
        goal = state.plan.goals[state.next]
        well = success or (state.asked and not self.failure)
        state.running = False
        state.next += 1
        if not well and not self.failure:
            name = f"{arm}: {goal.name}" if len(self._arms) > 1 else goal.name
            self.failure = f"{name}: {reason}"
        return well

    def partners(self, arm: str) -> Partners:
        """Whom an arm minds: those without whom it does not begin, and those that do not without it."""
        plan = self._arms[arm].plan
        return Partners(awaited_by(plan, self._plans), waiting_for(plan, self._plans))

    def _may_begin(self, state: _ArmState) -> bool:
        after = state.plan.role.after
        return after is None or all(
            after[1] in self._arms[arm].phases for arm in awaited_by(state.plan, self._plans)
        )
