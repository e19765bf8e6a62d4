"""What a run tells, as the bytes of messages: nodes send them, a run without ROS writes them into a bag."""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from tactile_base import topics
from tactile_base.stamps import SECOND_NS, parts_from_ns
from tactile_control.phases import Command
from tactile_filter.belief import Belief
from tactile_filter.force import ForceGaussian
from tactile_geometry import se3
from tactile_perception.estimating.encodings import encoding_of
from tactile_scene.arm import ArmState
from tactile_sim.frame import Frame
from tactile_wire.cdr import Layout, blank_layout
from tactile_wire.errors import MessageError
from tactile_wire.packing import FRAME, headed_bytes, split_stamp
from tactile_wire.pose_numbers import numbers_from_pose

Array = NDArray[np.float64]

IDLE = "idle"
PIXELS = "data"  # of an Image
STILL = 128  # flag of tactile_msgs/ContactState
_SAID = ("reason", "owner", "limited_by", "refused", "refused_source", "remark")
_ZERO, _UNKNOWN = np.zeros(6), np.full(6, np.nan)


def pose_bytes(state: ArmState, frame_id: str) -> bytes:
    """PoseStamped: where the arm's controlled frame is in its base."""
    numbers = numbers_from_pose(state.T_base_controlled).tolist()
    return headed_bytes(topics.ARM_POSE.type, state.stamp_ns, frame_id, *numbers)


def arm_status_bytes(state: ArmState, frame_id: str) -> bytes:
    """ArmStatus: what the arm does, and why."""
    numbers = int(state.mode), state.command_age, state.limited, *state.twist.tolist()
    texts = {name: getattr(state, name) for name in _SAID}
    return headed_bytes(topics.ARM_STATUS.type, state.stamp_ns, frame_id, *numbers, **texts)


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
        topics.CONTROLLER_STATUS.type,
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


def state_bytes(
    belief: Belief, frame_id: str, emitted_ns: int, still: bool = False, novelty: float = math.nan
) -> bytes:
    """ContactState of a belief; NaN where it holds nothing. `still` and `novelty` are of the images."""
    xi, euler = belief.vectors()
    latency = parts_from_ns(emitted_ns - belief.stamp_ns)
    return headed_bytes(
        topics.STATE.type,
        belief.stamp_ns,
        frame_id,
        *xi.tolist(),
        *belief.cov.ravel().tolist(),
        *euler.tolist(),
        belief.nis,
        belief.nis_dof,
        int(belief.flags) | (STILL if still else 0),
        belief.rejected,
        belief.inflation,
        novelty,
        *latency,
    )


def force_bytes(stamp_ns: int, frame_id: str, force: ForceGaussian, nis: float = math.nan) -> bytes:
    """ContactForce of a force's Gaussian."""
    numbers = *force.mean.tolist(), *force.cov.ravel().tolist(), nis
    return headed_bytes(topics.FORCE_BELIEF.type, stamp_ns, frame_id, *numbers)


def bytes_from_array(stamp_ns: int, frame_id: str, image: NDArray[np.uint8]) -> bytes:
    """Image of a gray one (height, width) uint8, mono8, or one in color (height, width, 3), bgr8."""
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
        raise MessageError(
            f"image: must be uint8 (height, width) or (height, width, 3), is {image.dtype} {image.shape}"
        )
    height, width = image.shape[:2]
    head = _head(frame_id, image.size, encoding_of(image)).pack(
        *split_stamp(stamp_ns), height, width, 0, width * (3 if image.ndim == 3 else 1)
    )
    return b"".join((head, np.ascontiguousarray(image).data))


@functools.lru_cache(maxsize=16)
def _head(frame_id: str, size: int, encoding: str) -> Layout:
    """What stands before the pixels."""
    texts = {FRAME: frame_id, "encoding": encoding}
    return blank_layout(topics.IMAGE.type, texts, {PIXELS: size}).before(PIXELS)


def truth_bytes(frame: Frame, base_frame: str) -> bytes:
    """ContactTruth of a frame of the simulation."""
    truth = frame.truth
    valid = bool(np.isfinite(truth.T_fs).all())
    return headed_bytes(
        topics.TRUTH.type,
        frame.stamp_ns,
        base_frame,
        truth.in_contact,
        truth.depth,
        truth.normal_angle,
        *(se3.euler_from_pose(truth.T_fs) if valid else _UNKNOWN).tolist(),
        *np.asarray(truth.shear).tolist(),
        truth.slip_fraction,
        truth.normal_force,
        *numbers_from_pose(frame.T_base_sensor).tolist(),
        *truth.point.tolist(),
        *truth.normal.tolist(),
    )
