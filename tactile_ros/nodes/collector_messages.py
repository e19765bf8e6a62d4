"""What the collector node says of a collection: status and the action's feedback."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tactile_control.collection import (
    CAPTURE,
    CONTACT,
    REFERENCE,
    ROTATE,
    SHEAR,
    TOUCH,
    CollectionCommand,
)
from tactile_msgs.action import RunTask
from tactile_msgs.msg import ControllerStatus
from tactile_ros.conversions import header

IDLE = "idle"
ZERO = np.zeros(6)
#: What a phase counts as in ControllerStatus.
CODES = {
    REFERENCE: ControllerStatus.SETTLE,
    TOUCH: ControllerStatus.APPROACH,
    ROTATE: ControllerStatus.GO_TO_START,
    CONTACT: ControllerStatus.APPROACH,
    SHEAR: ControllerStatus.FOLLOW,
    CAPTURE: ControllerStatus.SETTLE,
}


def phase_code(phase: str) -> int:
    """The constant of ControllerStatus that is nearest to a phase of collection."""
    return int(CODES[phase] if phase in CODES else getattr(ControllerStatus, phase.upper()))


def status_message(now_ns: int, sensor_frame: str, command: CollectionCommand | None) -> ControllerStatus:
    """What the collector does; None where it has nothing to do. `path` is the sample's number."""
    if command is None:
        return ControllerStatus(
            header=header(now_ns, sensor_frame), phase_name=IDLE, error=np.full(6, np.nan), belief_age=-1.0
        )
    return ControllerStatus(
        header=header(now_ns, sensor_frame),
        phase=phase_code(command.phase),
        phase_name=command.phase,
        path=command.number,
        path_name=f"sample {command.number}",
        reason=command.reason,
        error=np.full(6, np.nan),
        feedforward=ZERO,
        unlimited=command.unlimited,
        limited=command.twist,
        saturated=(np.abs(command.unlimited - command.twist) > 1e-12).tolist(),
        progress=command.collected / command.total,
        path_length=command.travelled,
        belief_age=-1.0,
    )


def feedback_message(
    command: CollectionCommand, before: int, X_fs: NDArray[np.float64] | None
) -> RunTask.Feedback:
    """Progress over all samples of the folder, `before` of which were there; X_fs (4, 4) is the sensor's."""
    depth, normal_error = math.nan, math.nan
    if X_fs is not None:
        depth, normal_error = float(X_fs[2, 3]), math.acos(max(-1.0, min(1.0, float(X_fs[2, 2]))))
    return RunTask.Feedback(
        phase=phase_code(command.phase),
        phase_name=command.phase,
        reason=command.reason,
        progress=(before + command.collected) / (before + command.total),
        path_length=command.travelled,
        depth=depth,
        normal_error=normal_error,
    )
