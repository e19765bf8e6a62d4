"""One step of a task that may be anybody's: what it raises, or gives that no step can give, fails it.

`PhaseMachine.step` raises nothing, but a task may have a step of its own, or give a twist that is none. What
moves an arm calls `task_step` in its place, and gets a `Command` whatever happens.
"""

from __future__ import annotations

import traceback
from typing import Any

import numpy as np

from tactile_base.raised import defined_in, plugin_name, told
from tactile_control.phase_machine import PhaseMachine
from tactile_control.phases import FAILED, Command


def task_step(task: PhaseMachine, now_ns: int, inputs: Any) -> Command:
    """The task's step; a command that ends it, with a twist of zero, where it gives none that can be."""
    try:
        command = task.step(now_ns, inputs)
        wrong = _objection(task, command)
    except Exception as error:  # somebody else's code may raise anything
        task.traceback = task.traceback or traceback.format_exc()
        return _failed(told(error, type(task), f"{type(error).__name__} in phase {task.phase}: {error}"))
    if wrong:
        kind = type(task)
        return _failed(f"{plugin_name(kind) or kind.__name__}: {wrong} ({defined_in(kind)})")
    return command


def _objection(task: PhaseMachine, command: Any) -> str:
    """What is wrong with what a step gave, with what would be right; '' for nothing."""
    if not isinstance(command, Command):
        return f"step gives a {type(command).__name__}, must be a Command"
    twist = np.asarray(command.twist)
    if twist.shape != (6,) or not np.isfinite(twist).all():
        return f"in phase {command.phase} the twist is {twist!r}, must be six finite numbers"
    phases = type(task).phases
    if command.phase not in phases:
        return f"phase '{command.phase}' is not among its phases: {', '.join(phases)}"
    return ""


def _failed(reason: str) -> Command:
    """The last word on a task of which nothing more is asked."""
    return Command(np.zeros(6), np.zeros(6), FAILED, True, False, reason, "", trouble=reason)
