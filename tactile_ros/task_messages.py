"""What a node that runs tasks says beside its status; and what a goal of the action run_task asks for."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray

from tactile_base.settings import SettingError, SettingGroups
from tactile_base.yaml_file import text_of, values_of
from tactile_control.phase_machine import PhaseMachine
from tactile_control.phases import Command, Goal
from tactile_control.task_file import NamedGoal
from tactile_msgs.action import RunTask
from tactile_ros.conversions import header, matrix_from_pose, pose_from_matrix
from tactile_ros.message_bytes import LONGEST_NAME
from tactile_wire.errors import MessageError

Array = NDArray[np.float64]
TaskType = type[PhaseMachine]


def goal_message(task: str, named: NamedGoal) -> RunTask.Goal:
    """The message that asks for a goal."""
    message = RunTask.Goal(task=task, name=named.name, goal=text_of(named.goal))
    if named.start is not None:
        message.start = [pose_from_matrix(named.start)]
    return message


def named_goal(message: RunTask.Goal, task_type: TaskType) -> NamedGoal:
    """The goal that a message asks for.

    Raises
    ------
    SettingError
        Saying what is wrong with it, and what would be right.
    """
    if (found := len(message.name)) > LONGEST_NAME:
        raise SettingError(f"name: has {found} characters, must have no more than {LONGEST_NAME}")
    goal: Goal = task_type.goal_class.from_mapping(values_of(message.goal, "goal"), "goal")
    try:
        start = matrix_from_pose(message.start[0]) if message.start else None
    except MessageError as error:
        raise SettingError(f"start: {error}") from error
    return NamedGoal(message.name, goal, start)


def with_settings(message: RunTask.Goal, settings: SettingGroups) -> SettingGroups:
    """The settings with those in place that a goal's message asks for; raises `SettingError`."""
    return settings.merged(values_of(message.settings, "settings"), "settings")


def path_message(now_ns: int, frame_id: str, poses: Sequence[Array]) -> PoseArray:
    """Poses (4, 4) of the controlled frame in the base."""
    return PoseArray(header=header(now_ns, frame_id), poses=list(map(pose_from_matrix, poses)))


def feedback_message(command: Command, X_fs: Array | None) -> RunTask.Feedback:
    """The action's feedback; X_fs (4, 4) is the contact pose as far as it is known."""
    depth, normal_error = math.nan, math.nan
    if X_fs is not None:
        depth, normal_error = float(X_fs[2, 3]), math.acos(max(-1.0, min(1.0, float(X_fs[2, 2]))))
    said = {"phase": command.phase, "reason": command.reason, "progress": command.progress}
    return RunTask.Feedback(**said, path_length=command.travelled, depth=depth, normal_error=normal_error)
