"""What a node that runs tasks says: status and feedback; and what a goal of the action run_task asks for."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray

from tactile_base.settings import SettingError, SettingGroups
from tactile_base.stamps import SECOND_NS
from tactile_base.yaml_file import text_of, values_of
from tactile_control.phase_machine import PhaseMachine
from tactile_control.phases import Command, Goal
from tactile_control.task_file import NamedGoal
from tactile_geometry import se3
from tactile_msgs.action import RunTask
from tactile_msgs.msg import ControllerStatus
from tactile_ros.conversions import header, matrix_from_pose, pose_from_matrix
from tactile_ros.message_bytes import LONGEST_NAME, headed_bytes, split_stamp
from tactile_wire.errors import MessageError

Array = NDArray[np.float64]
TaskType = type[PhaseMachine]

IDLE = "idle"
_ZERO = np.zeros(6)
_UNKNOWN = np.full(6, np.nan)


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
    if len(message.name) > LONGEST_NAME:
        found = len(message.name)
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


def status_bytes(
    now_ns: int,
    frame_id: str,
    task: str,
    goal: tuple[int, str],
    command: Command | None,
    twist: Array,
    running: bool,
    belief_ns: int = 0,
) -> bytes:
    """ControllerStatus of the last command, if there is one, and the twist that went out.

    Parameters
    ----------
    goal : tuple (int, str)
        Number and name.
    running : bool
        Whether the command is of a goal that is under way, not of one that has ended.
    belief_ns : int
        Stamp of the newest belief; 0: there is none.
    """
    phase, reason = (command.phase, command.reason) if command else (IDLE, "")
    number, name = goal
    unlimited = command.unlimited if command and running else _ZERO
    hold = command.hold if command and running else None
    return headed_bytes(
        ControllerStatus,
        now_ns,
        frame_id,
        *split_stamp(command.exposure_ns if command and running else 0),
        number,
        bool(command and running and command.at_work),
        *split_stamp(hold.stamp_ns if hold else 0),
        *(se3.log(hold.T) if hold else _UNKNOWN).tolist(),
        *(command.error if command else _UNKNOWN).tolist(),
        *(command.reference if command else _UNKNOWN).tolist(),
        *(command.feedforward if command else _ZERO).tolist(),
        *unlimited.tolist(),
        *twist.tolist(),
        *(np.abs(unlimited - twist) > 1e-12).tolist(),
        command.progress if command else 0.0,
        command.travelled if command else 0.0,
        (now_ns - belief_ns) / SECOND_NS if belief_ns else -1.0,
        task=task,
        phase=phase,
        goal_name=name,
        reason=reason,
        trouble=command.trouble if command else "",
    )


def path_message(now_ns: int, frame_id: str, poses: Sequence[Array]) -> PoseArray:
    """Poses (4, 4) of the controlled frame in the base."""
    return PoseArray(header=header(now_ns, frame_id), poses=list(map(pose_from_matrix, poses)))


def feedback_message(command: Command, X_fs: Array | None) -> RunTask.Feedback:
    """The action's feedback; X_fs (4, 4) is the contact pose as far as it is known."""
    depth, normal_error = math.nan, math.nan
    if X_fs is not None:
        depth, normal_error = float(X_fs[2, 3]), math.acos(max(-1.0, min(1.0, float(X_fs[2, 2]))))
    return RunTask.Feedback(
        phase=command.phase,
        reason=command.reason,
        progress=command.progress,
        path_length=command.travelled,
        depth=depth,
        normal_error=normal_error,
    )
