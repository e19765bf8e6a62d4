"""What a Franka arm says of itself through franky, in words for its user."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from tactile_geometry import se3

#: Errors of the arm, and what the user should read of them.
_WORDS = {
    "joint_reflex": "joint reflex: more torque on a joint than driver_settings.collision_torque",
    "cartesian_reflex": "Cartesian reflex: more force on the tool than driver_settings.collision_force",
    "communication_constraints_violation": "commands came too late or not at all; it takes a real-time "
    "kernel and a cable without anything in between",
}  # fmt: skip
#: What franky says, and what the user should read instead.
_ANSWERS = (
    ("refused", "it does not answer on port 1337; is FCI activated in Desk?"),
    ("timeout", "it does not answer on port 1337; is FCI activated in Desk?"),
    ("realtime|scheduling|priority", "the kernel has no real-time priorities, or grants you none "
     "(docs/own_arm.md#franka); without them: driver_settings.realtime: false"),
    ("manual error recovery", "it has to be recovered by hand, in Desk"),
    ("safety functions", "it is stopped by its safety functions; release the stop"),
)  # fmt: skip
_VERSIONS = re.compile(r"server version: (\d+), library version: (\d+)")


def state_of(robot: Any) -> Any:
    """The newest state of franky's; raises `RuntimeError` for one that cannot be."""
    state = robot.state
    try:
        se3.checked_pose("pose", np.asarray(state.O_T_EE.matrix))
    except se3.PoseError as error:
        raise RuntimeError(f"what the arm tells makes no sense: {error}") from error
    return state


def why_not(state: Any) -> str:
    """Why an arm in this state does not move; '' if it does."""
    mode = state.robot_mode.name
    if mode == "UserStopped":
        return "the user stop is pressed, or another safety function of the arm is active"
    if mode == "Guiding":
        return "the arm is moved by hand (guiding)"
    if errors := errors_of(state):
        return "; ".join(_WORDS.get(name, name.replace("_", " ")) for name in errors)
    if mode not in ("Idle", "Move"):
        return f"the arm is in mode '{mode}'; are its joints unlocked and FCI activated in Desk?"
    return ""


def errors_of(state: Any) -> list[str]:
    """Names of the errors that keep the arm from moving."""
    errors = state.current_errors
    return [name for name in dir(errors) if getattr(errors, name) is True]


def in_words(error: Exception) -> str:
    """What an error of franky means."""
    text = str(error)
    if versions := _VERSIONS.search(text):
        return (
            f"it speaks version {versions[1]} of the control interface, and this franky {versions[2]}: "
            "install the one for its version (docs/own_arm.md#franka)"
        )
    known = (words for pattern, words in _ANSWERS if re.search(pattern, text, re.IGNORECASE))
    return next(known, text.removeprefix("libfranka: ") or repr(error))
