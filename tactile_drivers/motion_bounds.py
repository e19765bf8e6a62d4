"""MotionBounds: how much of a twist an arm may make where it is now, and what makes it less."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_drivers.arm_distance import Neighbour
from tactile_scene import _native
from tactile_scene.arm import ArmState
from tactile_scene.arm_settings import ArmLimits, SafetySettings
from tactile_scene.kinematics.joint_limits import Kinematics, allowed_part, joint_rates

if TYPE_CHECKING:
    from tactile_scene.scene import ArmScene

Array = NDArray[np.float64]

_AXES = "xyz"
#: What `bounds_in_words` tells: limits of speed, acceleration and jerk, where the arm may go, what it feels.
BOUNDS = ("limits", "workspace", "touch limits")


class MotionBounds:
    """Speed, contact, workspace, joints and other arms.

    Parameters
    ----------
    arm : ArmScene
    feels : bool
        Whether somebody says what the arm's sensor feels (`take_contact`).

    Attributes
    ----------
    neighbours : sequence of Neighbour
        The other arms that it minds.
    delay : float
        Until the arm brakes (s): it has to hear of it, and may be speeding up still.
    """

    def __init__(self, arm: ArmScene, feels: bool) -> None:
        self._settings = arm.safety
        self.delay = _delay(arm.limits, arm.safety)
        self.neighbours: Sequence[Neighbour] = ()
        self._tip_radius = arm.sensor.settings.tip_radius if arm.sensor is not None and feels else 0.0
        self._most_force = arm.sensor.settings.protective_force if arm.sensor is not None and feels else 0.0
        self._room, self._boxes, self._reasons = _room(arm)
        self.forget()

    def forget(self) -> None:
        """Nothing is known of the contact."""
        self._contact: tuple[int, Array] | None = None  # stamp, T_base_feature
        self._felt_ns: int | None = None  # stamp of the last word on the contact, also that there is none
        self._pressed: tuple[int, float] | None = None  # stamp, size of the force (N)

    def take_contact(self, stamp_ns: int, T_base_feature: Array | None) -> None:
        """Take where the feature (4, 4) is that the sensor touches; None: it touches nothing."""
        self._felt_ns = max(stamp_ns, self._felt_ns or stamp_ns)
        self._contact = None if T_base_feature is None else (stamp_ns, T_base_feature)

    def take_force(self, stamp_ns: int, force: Array) -> None:
        """Take the force (3,) on the sensor, N."""
        self._pressed = stamp_ns, float(np.linalg.norm(force))

    def allowed(
        self, state: ArmState, twist: Array, kinematics: Kinematics | None
    ) -> tuple[Array, list[str]]:
        """The part of a twist (6,) that the arm may make in a state, and what makes it less."""
        felt = None
        if self._contact is not None and not self._is_old(self._contact[0], state.stamp_ns):
            felt = self._contact[1]
        out, less = _native.bounded(twist, self._room, self._boxes, state.T_base_controlled, felt)
        reasons = [self._reasons[number] for number in less]
        if self._tip_radius and (self._felt_ns is None or self._is_old(self._felt_ns, state.stamp_ns)):
            out, crawls = self._crawling(out)
            reasons += [f"no word of the contact: {self._settings.crawl_speed:g} m/s"] * crawls
        if self._presses_too_hard(state.stamp_ns) and out[2] > 0.0:
            out = out * np.array([1.0, 1.0, 0.0, 1.0, 1.0, 1.0])
            reasons.append(f"force {self._most_force:g} N")
        part, reason = self._joints_allow(state, out, kinematics)
        return (part * out, [*reasons, reason]) if part < 1.0 else (out, reasons)

    def _presses_too_hard(self, stamp_ns: int) -> bool:
        """Whether the sensor is pressed with more than it may be; then it goes no further along its z."""
        pressed = self._pressed
        if not self._most_force or pressed is None or self._is_old(pressed[0], stamp_ns):
            return False
        return pressed[1] > self._most_force

    def _is_old(self, felt_ns: int, stamp_ns: int) -> bool:
        return stamp_ns - felt_ns > self._settings.contact_memory * SECOND_NS

    def _crawling(self, twist: Array) -> tuple[Array, bool]:
        """What an arm makes of a twist that feels nothing, out of a contact all and the rest slowly."""
        out = np.array([0.0, 0.0, min(twist[2], 0.0), 0.0, 0.0, 0.0])
        speed = self._settings.crawl_speed
        slow = _native.shortened(twist - out, speed, speed / self._tip_radius)
        return out + slow, _native.any_differs(out + slow, twist, 0.0)

    def _joints_allow(
        self, state: ArmState, twist: Array, kinematics: Kinematics | None
    ) -> tuple[float, str]:
        """What joints and neighbours allow; all of it where nothing is known of the joints."""
        if kinematics is None or state.joints is None or not _native.is_moving(twist):
            return 1.0, ""
        rates = joint_rates(kinematics, state.joints, twist)
        slow, stop = self._settings.singularity_slow, self._settings.singularity_stop
        part, reason = allowed_part(kinematics, state.joints, rates, self.delay, slow, stop)
        for neighbour in self.neighbours:
            apart, other = neighbour.allowed_part(state, part * twist, part * rates, self.delay)
            part, reason = (part * apart, other) if apart < 1.0 else (part, reason)
        return part, reason


def bounds_in_words(arm: ArmScene, feels: bool) -> dict[str, str]:
    """What bounds the arm's motion, for a person, by the names of `BOUNDS`; `feels` as of `SafeArm`."""
    limits, safety = arm.limits, arm.safety
    corners = zip(_AXES, safety.workspace_lower, safety.workspace_upper, strict=True)
    box = ", ".join(f"{axis} {1e3 * lower:g} to {1e3 * upper:g}" for axis, lower, upper in corners)
    words = [
        f"{1e3 * limits.linear_velocity:g} mm/s, {math.degrees(limits.angular_velocity):.3g} deg/s; "
        f"{limits.linear_acceleration:g} m/s^2, {limits.angular_acceleration:g} rad/s^2; "
        f"{limits.linear_jerk:g} m/s^3, {limits.angular_jerk:g} rad/s^3",
        f"{box} mm, in the base" + "".join(f"; not in {each.name}" for each in arm.keep_out),
    ]
    if arm.sensor is not None:
        depth, shear = arm.sensor.settings.protective_depth, safety.largest_shear
        crawl = f"; {1e3 * safety.crawl_speed:g} mm/s without news of the contact"
        force = arm.sensor.settings.protective_force
        pressed = f", {force:g} N" if force else ""
        felt = f"{1e3 * depth:g} mm deep, {1e3 * shear:g} mm of shear{pressed}{crawl}"
        words.append(felt if feels else "none: nobody tells what the sensor feels")
    return dict(zip(BOUNDS, words, strict=False))


def _delay(limits: ArmLimits, safety: SafetySettings) -> float:
    return safety.reaction_time + limits.linear_acceleration / limits.linear_jerk


def _room(arm: ArmScene) -> tuple[Array, Array, list[str]]:
    """What bounds an arm as C takes it, room (13,) and boxes (n, 6), and in words, by C's numbers."""
    limits, safety = arm.limits, arm.safety
    sensor = arm.sensor.settings if arm.sensor is not None else None
    depth = sensor.protective_depth if sensor is not None else np.inf
    room = [
        limits.linear_velocity, limits.angular_velocity, limits.linear_acceleration,
        limits.lead(_delay(limits, safety)), *safety.workspace_lower, *safety.workspace_upper,
        sensor.tip_radius if sensor is not None else 0.0, depth, safety.largest_shear,
    ]  # fmt: skip
    reasons = ["speed"]
    for axis, low, high in zip(_AXES, safety.workspace_lower, safety.workspace_upper, strict=True):
        reasons += [f"workspace {axis} <= {high:g} m", f"workspace {axis} >= {low:g} m"]
    reasons += [f"depth {depth:g} m", f"shear {safety.largest_shear:g} m"]
    reasons += [f"kept out of {box.name}" for box in arm.keep_out]
    boxes = np.array([[*box.lower, *box.upper] for box in arm.keep_out]).reshape(-1, 6)
    return np.array(room), boxes, reasons
