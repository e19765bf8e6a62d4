"""SafeArm: the safe command stage, which has the last word between every controller and every driver.

    arm = SafeArm(scene.arms["arm"], clock)                       # clock(): now, ns
    arm.drive(open_arm(scene.arms["arm"], arm.take_state))
    refusal = arm.command(stamp_ns, twist, "/arm/controller")     # '' where it is followed

A command is refused from anybody but the arm's owner, out of time, not finite, in an emergency stop or a
fault. What is followed is made less, at each command and again at each state of the driver, so that the arm
can still come to rest before the sensor is too deep or sheared too far, before it leaves its workspace or
enters a box that is kept out (`ArmLimits.braking_speed`), and where its kinematics are known before a joint
ends, a singularity, or another arm. docs/safety.md draws the states, and what leads from one to another.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.stamps import SECOND_NS
from tactile_drivers import _native
from tactile_drivers.arm import Arm, ArmLimits, ArmMode, ArmState, SafetySettings
from tactile_drivers.arm_distance import Neighbour
from tactile_drivers.joint_limits import Kinematics, allowed_part, joint_rates
from tactile_drivers.twist_profile import TwistProfile
from tactile_filter import se3
from tactile_filter.transform_buffer import TransformBuffer, TransformUnavailable

if TYPE_CHECKING:
    from tactile_drivers.scene import ArmScene

Array = NDArray[np.float64]

_SAME_TWIST = 1e-9  # m/s and rad/s: below this, a twist is as commanded
_AXES = "xyz"
_OFF, _TURNED = 0.02, 0.05  # m, rad, by which an arm may differ from its kinematics


class SafeArm:
    """The driver of an arm behind the safe command stage; see the module's text. Any thread may call it.

    Parameters
    ----------
    arm : ArmScene
        Its limits, safety settings, boxes that are kept out, and tip.
    clock : callable
        The time now, ns, on the clock of the commands' stamps.

    Attributes
    ----------
    driver : Arm or None
        Who moves the arm; None while nobody does.
    state : ArmState or None
        The newest state, completed; None before the first.
    bad_state : str
        Why the last state of the driver cannot be true; '' if it can.
    neighbours : sequence of Neighbour
        The other arms that it minds; none until somebody says so (`mind_others`).
    """

    def __init__(self, arm: ArmScene, clock: Callable[[], int]) -> None:
        self.limits, self.settings = arm.limits, arm.safety
        self._room, self._boxes, self._reasons = _room(arm)
        self.neighbours: Sequence[Neighbour] = ()
        self._clock = clock
        self._lock = threading.RLock()
        self._estop = ""
        self._in_force_ns: int | None = None  # stamp of the command in force
        self._sent_ns: int | None = None
        self._held_back = ""
        self._stopping = ""  # why, while a driver that keeps no limits is led to rest
        self.drive(None)

    def drive(self, driver: Arm | None) -> None:
        """Have this driver move the arm from now on; an emergency stop stays in force."""
        with self._lock:
            self.driver = driver
            self.state: ArmState | None = None
            self.bad_state = self._fault = ""
            self._owner, self._heard_ns = "", 0
            self._waits_for_rest = bool(self._estop)
            self._last_refusal = ""
            self._contact: tuple[int, Array] | None = None  # stamp, T_base_feature
            self._track = TransformBuffer(SECOND_NS)
            self._profile = TwistProfile(self.limits)
            self._drop()

    # ---- commands ----

    def command(self, stamp_ns: int, twist: ArrayLike, owner: str = "") -> str:
        """Ask for a twist (6,) of the controlled frame, in that frame, emitted at `stamp_ns` by `owner`.

        Returns why it is refused; '' where it is followed, as far as the bounds allow.
        """
        wanted = np.asarray(twist, dtype=np.float64)
        with self._lock:
            now_ns = self._clock()
            refusal = self._refusal(now_ns, int(stamp_ns), wanted, owner)
            if refusal:
                self._last_refusal = refusal
                return refusal
            if self._in_force_ns is None and not self._stopping and self.state is not None:
                self._profile.start(self.state.twist)
            self._stopping = ""
            self._wanted, self._in_force_ns, self._last_refusal = wanted, int(stamp_ns), ""
            self._steer(0.0)
        return ""

    def stop(self, reason: str) -> None:
        """Bring the arm to rest within its limits; the next command moves it again."""
        with self._lock:
            self._drop()
            if self.driver is None:
                return
            if self.driver.keeps_limits or not _native.moves(self._profile.twist):
                self.driver.stop(reason)
            else:  # its states lead it to rest
                self._stopping = reason

    def halt(self, reason: str) -> None:
        """Have the driver stop the arm as it can, whether it still says anything or not."""
        with self._lock:
            self._let_go()
            if self.driver is not None:
                self.driver.stop(reason)

    def estop(self, reason: str) -> None:
        """Stop the arm at once, and keep it at rest until `reset`."""
        with self._lock:
            self._estop = self._estop or reason or "no reason given"
            self._waits_for_rest = True
            self.halt(f"emergency stop: {self._estop}")

    @property
    def estopped(self) -> bool:
        """Whether an emergency stop is in force."""
        return bool(self._estop)

    def reset(self) -> None:
        """Leave an emergency stop and a fault; the arm moves no earlier than commands have been zero once.

        Raises
        ------
        RuntimeError
            If the arm cannot leave its fault, with the reason.
        """
        driver, fault = self.driver, self._fault
        if driver is not None and fault:
            driver.recover()  # which may take its time, and states of its own
        with self._lock:
            self._estop = ""

    def close(self) -> None:
        """Stop, and let go of the arm."""
        driver, self.driver = self.driver, None
        if driver is not None:
            driver.close()

    def _refusal(self, now_ns: int, stamp_ns: int, twist: Array, owner: str) -> str:
        """Why the command is not followed; '' if it is."""
        if twist.shape != (6,):
            return f"a twist has 6 elements, this one has shape {twist.shape}"
        if not _native.finite(twist):
            return f"the twist is not finite: {twist.tolist()}"
        if self.driver is None or self.state is None:
            return "nobody drives the arm yet" if self.driver is None else "the arm has no state yet"
        quiet = (now_ns - self._heard_ns) / SECOND_NS > self.settings.owner_timeout
        if self._owner and owner != self._owner and not quiet:
            return f"the arm is commanded by {self._owner}, not by {owner or 'somebody without a name'}"
        if reason := self._out_of_time(now_ns, stamp_ns, owner):
            return reason
        self._owner, self._heard_ns = owner, now_ns
        if self._estop:
            return f"emergency stop: {self._estop}; arm/reset leaves it"
        if self._fault:
            return f"the arm is in fault: {self._fault}; arm/reset leaves it"
        self._waits_for_rest = self._waits_for_rest and not quiet and _native.moves(twist)
        if self._waits_for_rest:
            return "after a stop by safety the arm waits for a twist of zero"
        return ""

    def _out_of_time(self, now_ns: int, stamp_ns: int, owner: str) -> str:
        age = (now_ns - stamp_ns) / SECOND_NS
        if age > self.limits.command_timeout:
            return f"the command is {age:.3f} s old (limit {self.limits.command_timeout:g} s)"
        if age < -self.settings.future_tolerance:
            limit = self.settings.future_tolerance
            return f"the command is stamped {-age:.3f} s ahead of the clock (limit {limit:g} s)"
        if self._in_force_ns is not None and owner == self._owner and stamp_ns < self._in_force_ns:
            behind = (self._in_force_ns - stamp_ns) / SECOND_NS
            return f"the command is {behind:.3f} s older than the one in force"
        return ""

    # ---- what is known of arm and contact ----

    def take_state(self, state: ArmState) -> ArmState | None:
        """Look at a state of the driver, and at the command in force again; the state completed.

        None for one that cannot be true, which counts as if the driver had said nothing.
        """
        with self._lock:
            self.bad_state = self._implausible(state)
            if self.bad_state:
                return None
            dt = (state.stamp_ns - self.state.stamp_ns) / SECOND_NS if self.state is not None else 0.0
            self._track.set_transform("base", "controlled", state.stamp_ns, state.T_base_controlled)
            self.state = state
            stopped = state.mode in (ArmMode.FAULT, ArmMode.ESTOP)  # by the arm's own safety
            self._fault = (state.reason or "no reason given") if stopped else ""
            if self._fault:
                self._waits_for_rest = True
                self._let_go()
            self._steer(dt)
            self.state = self._completed(state)
            return self.state

    def take_contact(self, stamp_ns: int, X_sf: Array | None) -> None:
        """Take what is believed of the contact, X_sf (4, 4) at a stamp; None: there is none."""
        with self._lock:
            if X_sf is None:
                self._contact = None
                return
            try:
                T_base_sensor = self._track.lookup("base", "controlled", stamp_ns)
            except TransformUnavailable:
                return  # without the pose then it bounds nothing now; the last one still does for a while
            self._contact = stamp_ns, se3.compose(T_base_sensor, X_sf)

    def _implausible(self, state: ArmState) -> str:
        """Why a state cannot be true; '' if it can."""
        try:
            se3.checked_pose("pose", state.T_base_controlled)
        except se3.PoseError as error:
            return str(error)
        if not _native.finite(state.twist):
            return f"twist is not finite: {np.asarray(state.twist).tolist()}"
        if state.joints is not None and not np.isfinite(state.joints).all():
            return f"joints are not finite: {np.asarray(state.joints).tolist()}"
        if self.state is None:
            return self._another_arm(state)
        elapsed = (state.stamp_ns - self.state.stamp_ns) / SECOND_NS
        if elapsed < 0.0:
            return f"the state is {-elapsed:.3f} s older than the last one"
        way = _native.apart(state.T_base_controlled, self.state.T_base_controlled)
        # each axis has the limit, and the clock of an arm is not ours
        if way > self.settings.jump + 2.0 * self.limits.linear_velocity * elapsed:
            return f"the arm cannot have moved by {way * 1e3:.1f} mm in {elapsed * 1e3:.1f} ms"
        return ""

    def _another_arm(self, state: ArmState) -> str:
        """Why the joints of a state are not those of the kinematics; '' if they are, or are not known."""
        kinematics: Kinematics | None = getattr(self.driver, "kinematics", None)
        if kinematics is None or state.joints is None:
            return ""
        if len(state.joints) != len(kinematics.names):
            return f"the arm tells {len(state.joints)} joints, its kinematics have {len(kinematics.names)}"
        error = se3.log(se3.inverse(kinematics.pose(state.joints)) @ state.T_base_controlled)
        way, turn = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
        if way <= _OFF and turn <= _TURNED:
            return ""
        return (
            f"with its joints as they are, its kinematics in the scene put it {way * 1e3:.0f} mm and "
            f"{np.degrees(turn):.0f} degrees from where it says it is: are `description` "
            "and `tool` those of this arm?"
        )

    def _completed(self, state: ArmState) -> ArmState:
        """The driver's state with what the stage knows."""
        in_force = self._in_force_ns is not None
        age = (state.stamp_ns - self._in_force_ns) / SECOND_NS if self._in_force_ns is not None else -1.0
        reason = state.reason
        if reason and self._last_refusal and state.mode in (ArmMode.STOPPING, ArmMode.RESTING):
            reason = f"{reason}; last refused: {self._last_refusal}"
        return ArmState(
            state.stamp_ns,
            state.T_base_controlled,
            state.twist,
            ArmMode.ESTOP if self._estop else state.mode,
            f"emergency stop: {self._estop}" if self._estop else reason,
            state.joints,
            self._owner,
            age,
            in_force and _native.differ(self._wanted, state.twist, _SAME_TWIST),
            self._held_back,
        )

    # ---- what is passed on ----

    def _drop(self) -> None:
        """There is no command in force any more."""
        self._wanted = self._sent = np.zeros(6)
        self._in_force_ns = self._sent_ns = None
        self._held_back = self._stopping = ""

    def _let_go(self) -> None:
        """The arm comes to rest by itself: nothing leads it there, and no later `stop` begins to."""
        self._drop()
        self._profile.start(np.zeros(6))

    def _steer(self, dt: float) -> None:
        """Pass on as much of the command in force as the bounds allow, if that is news to the driver."""
        if self.driver is None or self.state is None or (self._in_force_ns is None and not self._stopping):
            return
        target, self._held_back = self._bounded(self._wanted)
        if not self.driver.keeps_limits:
            self._profile.advance(dt, target)
            target = self._profile.twist
        if self._stopping and not _native.moves(target):
            self.halt(self._stopping)
        elif self._sent_ns != self._in_force_ns or _native.differ(target, self._sent, 0.0):
            self.driver.command(self._in_force_ns or self.state.stamp_ns, target)
            self._sent, self._sent_ns = target, self._in_force_ns

    def _bounded(self, twist: Array) -> tuple[Array, str]:
        """The part of a twist that is followed, and what makes it less ('' where nothing does)."""
        assert self.state is not None
        out, less = _native.bounded(
            twist, self._room, self._boxes, self.state.T_base_controlled, self._felt(self.state.stamp_ns)
        )
        reasons = [self._reasons[number] for number in less]
        part, reason = self._joints_allow(out)
        if part < 1.0:
            out, reasons = part * out, [*reasons, reason]
        return out, "; ".join(reasons)

    def _felt(self, stamp_ns: int) -> Array | None:
        """T_base_feature (4, 4) of the contact that bounds the motion at a stamp; None where none does."""
        if self._contact is None or stamp_ns - self._contact[0] > self.settings.contact_memory * SECOND_NS:
            return None
        return self._contact[1]

    def _joints_allow(self, twist: Array) -> tuple[float, str]:
        """What joints and neighbours allow; all of it where nothing is known of the joints."""
        kinematics = getattr(self.driver, "kinematics", None)
        assert self.state is not None
        if kinematics is None or self.state.joints is None or not _native.moves(twist):
            return 1.0, ""
        rates = joint_rates(kinematics, self.state.joints, twist)
        slow, stop = self.settings.singularity_slow, self.settings.singularity_stop
        part, reason = allowed_part(kinematics, self.state.joints, rates, self._delay, slow, stop)
        for neighbour in self.neighbours:
            apart, other = neighbour.allowed_part(self.state, part * twist, part * rates, self._delay)
            part, reason = (part * apart, other) if apart < 1.0 else (part, reason)
        return part, reason

    @property
    def _delay(self) -> float:
        return _delay(self.limits, self.settings)


def _delay(limits: ArmLimits, safety: SafetySettings) -> float:
    """Until the arm brakes (s): it has to hear of it, and may be speeding up still."""
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
