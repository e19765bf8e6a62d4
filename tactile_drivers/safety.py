"""SafeArm: the safe command stage, which has the last word between every controller and every driver.

    arm = SafeArm(scene.arms["arm"], clock)                       # clock(): now, ns
    arm.attach_driver(open_arm(scene.arms["arm"], arm.take_state))
    refusal = arm.command(stamp_ns, twist, "/arm/controller")     # '' where it is followed

A command is refused from anybody but the arm's owner, out of time, not finite, in an emergency stop or a
fault. What is followed is made less, at each command and again at each state of the driver, so that the arm
can still come to rest before the sensor is too deep or sheared too far, before it leaves its workspace or
enters a box that is kept out (`ArmLimits.braking_speed`), and where its kinematics are known before a joint
ends, a singularity, or another arm. What the driver says is held against what the arm was told
(`tracking_monitor`): an arm that does otherwise is stopped, until a reset. docs/safety.md draws the states,
and what leads from one to another.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.stamps import SECOND_NS
from tactile_drivers.arm_distance import Neighbour
from tactile_drivers.arm_watch import ArmWatch
from tactile_drivers.motion_bounds import MotionBounds
from tactile_drivers.ownership import Commander, Ownership
from tactile_drivers.sender import CallTimer, Sender
from tactile_geometry import se3
from tactile_geometry.transform_buffer import TransformBuffer, TransformUnavailable
from tactile_scene import _native
from tactile_scene.arm import Arm, ArmMode, ArmState
from tactile_scene.kinematics.joint_limits import Kinematics
from tactile_scene.twist_profile import TwistProfile

if TYPE_CHECKING:
    from tactile_scene.scene import ArmScene

Array = NDArray[np.float64]

_SAME_TWIST = 1e-9  # m/s and rad/s: below this, a twist is as commanded
_INSIST_NS = SECOND_NS // 20  # between two stops of an arm that goes on
_REST = np.zeros(6)


class SafeArm:
    """The driver of an arm behind the safe command stage; see the module's text. Any thread may call it.

    Parameters
    ----------
    arm : ArmScene
        Its limits, safety settings, boxes that are kept out, and tip.
    clock : callable
        The time now, ns, on the clock of the commands' stamps.
    feels : bool
        Whether somebody says what the arm's sensor feels (`take_contact`). If so, an arm of which that is
        not known backs off, or crawls; without, only the workspace bounds how deep it goes.

    Attributes
    ----------
    driver : Arm or None
        Who moves the arm; None while nobody does.
    state : ArmState or None
        The newest state, completed; None before the first.
    bad_state : str
        Why the last state of the driver cannot be true; '' if it can.
    """

    def __init__(self, arm: ArmScene, clock: Callable[[], int], feels: bool = True) -> None:
        self.limits, self.settings = arm.limits, arm.safety
        self._clock = clock
        self._lock = threading.RLock()  # never taken on the way of an emergency stop to the driver
        self._calls = CallTimer()
        self._bounds = MotionBounds(arm, feels)
        self._watch = ArmWatch(arm.limits, arm.safety, arm.tracking, clock)
        self._ownership = Ownership(arm.safety.owner_timeout)
        self._estop, self._estops = "", 0
        self._in_force_ns: int | None = None  # stamp of the command in force
        self._sent_ns: int | None = None
        self._limited_by = ""
        self._stopping = ""  # why, while a driver that keeps no limits is led to rest
        self.driver: Arm | None = None
        self.attach_driver(None)

    def attach_driver(self, driver: Arm | None) -> None:
        """Have this driver move the arm from now on; an emergency stop stays in force."""
        with self._lock:
            prompt = driver is None or getattr(driver, "prompt", False)
            self.driver = driver if driver is None or prompt else Sender(driver)
            self._fault = ""
            self._ownership.leave()
            self._refused = "", ""
            self._bounds.forget()
            self._profile = TwistProfile(self.limits)
            self._begin_track()
            self._drop()

    def _begin_track(self) -> None:
        """Nothing is known of where the arm is, or was."""
        self.state: ArmState | None = None
        self.bad_state = ""
        self._track = TransformBuffer(SECOND_NS)
        self._watch.restart()
        self._insisted_ns = 0

    @property
    def alarm(self) -> str:
        """Why the stage has stopped the arm, which did what it was not told to, until a reset; else ''."""
        return self._watch.runaway or self._watch.alarm

    @property
    def neighbours(self) -> Sequence[Neighbour]:
        """The other arms that it minds; none until somebody says so."""
        return self._bounds.neighbours

    @neighbours.setter
    def neighbours(self, others: Sequence[Neighbour]) -> None:
        self._bounds.neighbours = others

    # ---- commands ----

    @property
    def owner(self) -> str:
        """Who commands the arm; '' for nobody."""
        return self._ownership.owner

    def command(
        self, stamp_ns: int, twist: ArrayLike, owner: str = "", session: int = 0, sequence: int = 0
    ) -> str:
        """Ask for a twist (6,) of the controlled frame, in that frame, emitted at `stamp_ns` by `owner`.

        `session` and `sequence` tell commanders of one name apart (`Ownership`). Returns why it is refused;
        '' where it is followed, as far as the bounds allow.
        """
        wanted, who = np.asarray(twist, dtype=np.float64), Commander(owner, session)
        with self._lock:
            refusal = self._refusal(self._clock(), int(stamp_ns), wanted, who, sequence)
            self._refused = refusal, owner if refusal else ""
            if refusal:
                if self._ownership.waits_for_rest and self._in_force_ns is not None:
                    self.stop(refusal)
                return refusal
            if self._in_force_ns is None and not self._stopping and self.state is not None:
                self._profile.start(self.state.twist)
            self._stopping = ""
            self._wanted, self._in_force_ns = wanted, int(stamp_ns)
            self._steer(0.0)
        return ""

    def stop(self, reason: str) -> None:
        """Bring the arm to rest within its limits; the next command moves it again."""
        with self._lock:
            self._drop()
            if self.driver is None:
                return
            if self.driver.keeps_limits or not _native.is_moving(self._profile.twist):
                self._stop_driver(reason)
            else:  # its states lead it to rest
                self._stopping = reason

    def halt(self, reason: str) -> None:
        """Have the driver stop the arm as it can, whether it still says anything or not."""
        with self._lock:
            self._clear_command()
            self._stop_driver(reason)

    def estop(self, reason: str) -> None:
        """Stop the arm at once, and keep it at rest until `reset`."""
        self._estop = self._estop or reason or "no reason given"
        self._estops += 1
        why = f"emergency stop: {self._estop}"
        driver = self.driver
        if driver is not None:  # first of all, and past every lock
            driver.stop(why)
        self.halt(why)  # again: a command may have been on its way

    def reset(self) -> None:
        """Leave an emergency stop, an alarm and a fault; the arm moves no earlier than after a zero command.

        An arm that is in none of these goes on as it is.

        Raises
        ------
        RuntimeError
            If the arm cannot leave its fault, or does not rest, with the reason.
        """
        if not (self._estop or self._fault or self.alarm):
            return
        driver, fault, estops = self.driver, self._fault, self._estops
        with self._lock:
            if self._watch.alarm and self._watch.moves and not self.bad_state:
                raise RuntimeError("the arm was told to rest, and moves")
        if driver is not None and fault:
            driver.recover()  # which may take its time, and states of its own
        with self._lock:
            if self._estops != estops:
                raise RuntimeError("an emergency stop was asked for meanwhile")
            self._estop = ""
            self._ownership.waits_for_rest = True
            if self._watch.alarm:
                self._begin_track()

    def close(self) -> None:
        """Stop, and let go of the arm."""
        driver, self.driver = self.driver, None
        if driver is not None:
            driver.close()

    def _refusal(self, now_ns: int, stamp_ns: int, twist: Array, who: Commander, sequence: int) -> str:
        """Why the command is not followed; '' if it is."""
        if twist.shape != (6,):
            return f"a twist has 6 elements, this one has shape {twist.shape}"
        if not _native.finite(twist):
            return f"the twist is not finite: {twist.tolist()}"
        if self.driver is None or (self.state is None and not self.alarm):
            return "nobody drives the arm yet" if self.driver is None else "the arm has no state yet"
        if reason := self._ownership.objection(now_ns, who, sequence):
            return reason
        if reason := self._out_of_time(now_ns, stamp_ns, who):
            return reason
        if self._estop:
            return f"emergency stop: {self._estop}; arm/reset leaves it"
        if self.alarm:
            return f"the arm was stopped: {self.alarm}; arm/reset leaves it"
        if self._fault:
            return f"the arm is in fault: {self._fault}; arm/reset leaves it"
        return self._ownership.hear(now_ns, who, sequence, _native.is_moving(twist))

    def _out_of_time(self, now_ns: int, stamp_ns: int, who: Commander) -> str:
        age = (now_ns - stamp_ns) / SECOND_NS
        if age > self.limits.command_timeout:
            return f"the command is {age:.3f} s old (limit {self.limits.command_timeout:g} s)"
        if age < -self.settings.future_tolerance:
            limit = self.settings.future_tolerance
            return f"the command is stamped {-age:.3f} s ahead of the clock (limit {limit:g} s)"
        in_force_ns = self._in_force_ns
        if in_force_ns is not None and self._ownership.is_owner(who) and stamp_ns < in_force_ns:
            behind = (in_force_ns - stamp_ns) / SECOND_NS
            return f"the command is {behind:.3f} s older than the one in force"
        return ""

    # ---- what is known of arm and contact ----

    def take_state(self, state: ArmState) -> ArmState | None:
        """Look at a state of the driver, and at the command in force again; the state completed.

        None for one that cannot be true, which counts as if the driver had said nothing.
        """
        with self._lock:
            self.bad_state = self._watch.objection(state, self._kinematics, self._is_others)
            if self.bad_state:
                if self._watch.alarm and isinstance(state, ArmState):
                    self._insist(state.stamp_ns)
                return None
            dt = (state.stamp_ns - self.state.stamp_ns) / SECOND_NS if self.state is not None else 0.0
            self._track.set_transform("base", "controlled", state.stamp_ns, state.T_base_controlled)
            self.state = state
            stopped = state.mode in (ArmMode.FAULT, ArmMode.ESTOP)  # by the arm's own safety
            self._fault = (state.reason or "no reason given") if stopped else ""
            if self._fault:
                self._ownership.waits_for_rest = True
                self._clear_command()
            # the arm's own safety has one in fault; it may be led by hand
            others = self._is_others or bool(self._fault and not self.alarm)
            if self._watch.see(state, self._sent if self._is_fresh(state.stamp_ns) else _REST, others):
                self._insist(state.stamp_ns)
            self._steer(dt)
            self.state = self._completed(state)
            return self.state

    def _insist(self, stamp_ns: int) -> None:
        """Stop an arm that there is an alarm about, and again while it goes on."""
        self._ownership.waits_for_rest = True
        if not 0 <= stamp_ns - self._insisted_ns < _INSIST_NS:
            self._insisted_ns = stamp_ns
            self.halt(self._watch.alarm)

    def _is_fresh(self, stamp_ns: int) -> bool:
        """Whether the command in force is not so old that the arm stops by itself."""
        limit = self.limits.command_timeout * SECOND_NS
        return self._in_force_ns is None or stamp_ns - self._in_force_ns <= limit

    @property
    def _is_others(self) -> bool:
        """Whether others may move the arm now, as nobody does here."""
        shared = getattr(self.driver, "shared", False)
        return shared and self._in_force_ns is None and not self._stopping

    @property
    def _kinematics(self) -> Kinematics | None:
        return getattr(self.driver, "kinematics", None)

    def take_contact(self, stamp_ns: int, X_sf: Array | None) -> None:
        """Take what is believed of the contact, X_sf (4, 4) at a stamp; None: there is none."""
        with self._lock:
            if X_sf is None:
                self._bounds.take_contact(stamp_ns, None)
                return
            try:
                T_base_sensor = self._track.lookup("base", "controlled", stamp_ns)
            except TransformUnavailable:
                return  # without the pose then it bounds nothing now; the last one still does for a while
            self._bounds.take_contact(stamp_ns, se3.compose(T_base_sensor, X_sf))

    def take_force(self, stamp_ns: int, force: Array) -> None:
        """Take the force (3,) that is believed to act on the sensor, N in {s}, at a stamp."""
        with self._lock:
            self._bounds.take_force(stamp_ns, force)

    def _completed(self, state: ArmState) -> ArmState:
        """The driver's state with what the stage knows."""
        in_force = self._in_force_ns is not None
        age = (state.stamp_ns - self._in_force_ns) / SECOND_NS if self._in_force_ns is not None else -1.0
        mode = ArmMode.ESTOP if self._estop else ArmMode.FAULT if self.alarm else state.mode
        reason = self._why(state)
        refused, source = self._refused
        if reason and refused and mode in (ArmMode.STOPPING, ArmMode.RESTING):
            reason = f"{reason}; last refused: {refused}"
        return replace(
            state,
            mode=mode,
            reason=reason,
            owner=self.owner,
            command_age=age,
            limited=in_force and _native.any_differs(self._wanted, state.twist, _SAME_TWIST),
            limited_by=self._limited_by,
            refused=refused,
            refused_source=source,
            remark=self._remarks(),
        )

    def _why(self, state: ArmState) -> str:
        """Why the arm does what it does; first of all that it does not stop."""
        estop = f"emergency stop: {self._estop}" if self._estop else ""
        told = [self._watch.runaway, estop, self._watch.alarm if not self._watch.runaway else ""]
        return "; ".join(filter(None, told)) or state.reason

    def _remarks(self) -> str:
        """What is not as it should be, and no fault yet."""
        slow = getattr(self.driver, "remark", "") or self._calls.remark
        return "; ".join(filter(None, (self._watch.remarks(), slow)))

    # ---- what is passed on ----

    def _stop_driver(self, reason: str) -> None:
        if self.driver is not None:
            self._watch.told_to_stop(reason)
            self._calls("stop", self.driver.stop, reason)

    def _drop(self) -> None:
        """There is no command in force any more."""
        self._wanted = self._sent = np.zeros(6)
        self._in_force_ns = self._sent_ns = None
        self._limited_by = self._stopping = ""
        self._watch.told(self._sent)

    def _clear_command(self) -> None:
        """The arm comes to rest by itself: nothing leads it there, and no later `stop` begins to."""
        self._drop()
        self._profile.start(np.zeros(6))

    def _steer(self, dt: float) -> None:
        """Pass on as much of the command in force as the bounds allow, if that is news to the driver."""
        if self.driver is None or self.state is None or (self._in_force_ns is None and not self._stopping):
            return
        target, less = self._bounds.allowed(self.state, self._wanted, self._kinematics)
        self._limited_by = "; ".join(less)
        if not self.driver.keeps_limits:
            self._profile.advance(dt, target)
            target = self._profile.twist
        if self._stopping and not _native.is_moving(target):
            self.halt(self._stopping)
        elif self._sent_ns != self._in_force_ns or _native.any_differs(target, self._sent, 0.0):
            self._calls("command", self.driver.command, self._in_force_ns or self.state.stamp_ns, target)
            self._sent, self._sent_ns = target, self._in_force_ns
            self._watch.told(target)
