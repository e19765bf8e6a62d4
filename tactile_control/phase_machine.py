"""PhaseMachine: runs the phases of a task, one twist a step.

    take in what has come -> watchdog: is all there that the phase needs, and young enough?
                          -> the phase: over, or which twist? -> limiter -> Command

An input that is too old takes the twist to zero. The task goes on when it is back; after the watchdog's
patience it fails where it is, since an arm that cannot feel or does not know where it is does not move; so it
does when nobody has made a step for as long. Every other failure leaves the surface first, an exception in
the task, too.
"""

from __future__ import annotations

import traceback
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tactile_base.raised import told
from tactile_base.settings import SettingGroups
from tactile_base.stamps import NANOSECOND
from tactile_control.limiter import TwistLimiter
from tactile_control.motion import Odometer
from tactile_control.phases import (
    DONE,
    FAILED,
    GO_TO_START,
    RETREAT,
    STOPPING,
    Command,
    Goal,
    InputRefused,
    Phase,
    PhaseFailed,
    StampedPose,
    StampedPresence,
    TaskInputs,
    newer,
)
from tactile_control.watchdog import Watchdog
from tactile_geometry import se3
from tactile_geometry.se3 import PoseError

Array = NDArray[np.float64]

AT_REST = 1e-6  # m/s and rad/s
PAUSE = 0.2  # s without a step, after which the arm has stopped by itself: the twist begins at zero again


class PhaseMachine(ABC):
    """Base of tasks; see the module's text. One object runs one goal, from `start` if it has one.

    Attributes
    ----------
    settings_class, goal_class : what can be set of the task, and what a goal says
    phases : names of its phases, for people, in their usual order
    work : the one of them in which it does what it is for
    needs_sensor : whether it needs a tactile sensor
    needs_images : whether it looks at the sensor's images itself, where others go by what is believed
    monitors_contact : whether it wants to know of a contact where the arm has a sensor, though it needs none
    endless : whether it goes on until it is asked to `finish`
    command_class : what a step says
    settings, goal, start : the settings in force, as the goal has adapted them; T_base_start (4, 4) or None
    phase, reason : what it does; why it fails, '' as long as it does not
    now_ns, since_ns : time of this step; when the phase began
    pose, presence, belief : the newest of each input, or None
    limited_by : what the limiter held back in the last step, as `Command.limited`
    traceback : where an exception in the task came from; '' for none
    remark : what whoever calls knows of inputs that do not come; it is told where one is missing or too old
    T_world_base : where the arm's base stands (4, 4); None: not known
    partner_hold : the newest `Command.hold` of another arm that works on the same object
    partner : why that arm does not go on (`partners`); as long as it says so this one rests too, as when an
        input is missing. It does not keep the task from leaving the surface.
    """

    settings_class: ClassVar[type[SettingGroups]]
    goal_class: ClassVar[type[Goal]] = Goal
    phases: ClassVar[tuple[str, ...]]
    work: ClassVar[str]
    needs_sensor: ClassVar[bool] = True
    needs_images: ClassVar[bool] = False
    monitors_contact: ClassVar[bool] = False
    endless: ClassVar[bool] = False
    command_class: ClassVar[type[Command]] = Command

    settings: Any
    goal: Any

    def __init__(self, settings: SettingGroups, goal: Goal, start: Array | None = None) -> None:
        self.goal, self.settings = goal, goal.adapted(settings)
        self.start = None if start is None else se3.checked_pose("start", start)
        self.limiter = TwistLimiter(self.settings.limiter)
        self.watchdog = Watchdog(self.settings.watchdog)
        self.odometer = Odometer(1e-4)
        self.pose: StampedPose | None = None
        self.presence: StampedPresence | None = None
        self.belief: StampedPose | None = None
        self.now_ns = self.since_ns = 0
        self.T_begun: Array | None = None
        self.reason = self.traceback = self.remark = self.partner = ""
        self.T_world_base: Array | None = None
        self.partner_hold: StampedPose | None = None
        self._ending = self._stepped = self._worked = False
        self._progress = 0.0
        self._wanted = np.zeros(6)
        self._refused = self._lacks = self.limited_by = ""
        self._parts: dict[str, Phase[Any]] = {part.name: part for part in self.make_phases()}
        self.phase = self.first_phase()

    # ---- what a task says ----

    @abstractmethod
    def make_phases(self) -> Iterable[Phase[Any]]:
        """Its phases, but for DONE and FAILED, in which nothing is done."""

    def first_phase(self) -> str:
        """The phase that it begins with."""
        return self.work if self.start is None else GO_TO_START

    @property
    def may_touch(self) -> bool:
        """Whether a stop is followed by the phase RETREAT, which the task then has."""
        return RETREAT in self.phases

    @property
    def meets_something(self) -> bool:
        """Contact where there should be air."""
        return False

    @property
    def nothing_left(self) -> bool:
        """Whether it is to end: it fails, was asked to, or has done all that its goal says."""
        return self._ending

    def progress(self) -> float:
        """How far it is, 0 to 1, by what is known now; what is told of it never goes back."""
        return 0.0

    def take(self, inputs: TaskInputs) -> None:
        """Keep each input if it is later than the last; `PoseError` and `InputRefused` refuse one."""
        if newer(inputs.sensor_pose, self.pose):
            se3.checked_pose("sensor pose", inputs.sensor_pose.T)
            self.pose = inputs.sensor_pose
            self.odometer.add(self.pose.T[:3, 3])
        if newer(inputs.belief, self.belief):
            self.belief = inputs.belief

    def before_phase(self) -> None:  # noqa: B027 (few have it)
        """Called in each step before the phase is asked; may enter another one, or raise `PhaseFailed`."""

    def ahead(self) -> list[Array]:
        """For people: poses (4, 4) in the base that lead to its goal, the last one there, as far as known."""
        return self.current_phase.ahead() if self.current_phase else []

    def details(self) -> dict[str, Any]:
        """What a step says beside what every task says: further fields of its `command_class`."""
        return {}

    def contact_pose(self) -> Array | None:
        """X_fs (4, 4), the sensor in the feature frame, as far as the task knows it."""
        return None if self.belief is None else se3.inverse(self.belief.T)

    def close(self) -> None:  # noqa: B027 (few have it)
        """Called once when its run has ended, for whatever reason; what it raises makes it a failure."""

    # ---- what the owner calls ----

    def configure(self, settings: Any) -> None:
        """Replace the settings, of `settings_class`; they hold from the next step on."""
        self.settings = self.goal.adapted(settings)
        self.limiter.configure(self.settings.limiter)
        self.watchdog.configure(self.settings.watchdog)

    def finish(self) -> None:
        """Ask the task to end as if its goal had been reached: it comes to rest and leaves the surface."""
        if self.phase not in (DONE, FAILED, STOPPING, RETREAT):
            self.enter(STOPPING)

    def stop(self, reason: str) -> None:
        """Ask the task to end: it comes to rest, leaves the surface if it may touch, fails with `reason`."""
        if self.phase in (DONE, FAILED, STOPPING) or self.reason:
            return
        self.reason, self._ending = reason or "stopped", True
        self.enter(RETREAT if self.phase == RETREAT else STOPPING)

    def abort(self, reason: str) -> None:
        """End where it is, coming to rest: the arm does not follow."""
        self._fail_here(reason)

    def step(self, now_ns: int, inputs: Any) -> Command:
        """Advance to `now_ns` with the latest inputs. Nothing raises: what is wrong fails the task."""
        if self._stepped:
            self._mind_pause((now_ns - self.now_ns) * NANOSECOND)
        else:
            self._stepped, self.since_ns = True, now_ns
            self._begin()
        self.now_ns = now_ns
        self._refused = self._lacks = ""
        try:
            self.take(inputs)
        except (PoseError, InputRefused) as error:
            self._refused = f" (the last one was refused: {error})"
        try:
            return self._command(*self._next_twist())
        except Exception as error:
            return self._after_exception(error)

    # ---- what phases use ----

    @property
    def current_phase(self) -> Phase[Any] | None:
        """The phase that it is in; None at its end."""
        return self._parts.get(self.phase)

    @property
    def T_base_sensor(self) -> Array:
        """The newest pose (4, 4) of the controlled frame in the base."""
        assert self.pose is not None
        return self.pose.T

    @property
    def elapsed(self) -> float:
        """Seconds since the phase began."""
        return (self.now_ns - self.since_ns) * NANOSECOND

    @property
    def at_rest(self) -> bool:
        """Whether the twist sent last was zero."""
        return bool(np.abs(self.limiter.twist).max() <= AT_REST)

    @property
    def outcome(self) -> str:
        """The phase that it ends in, as things stand."""
        return FAILED if self.reason else DONE

    def enter(self, phase: str) -> None:
        """Go on with the phase of that name."""
        self.phase, self.since_ns, self.T_begun = phase, self.now_ns, None
        self._ending = self._ending or phase == STOPPING
        self.watchdog.reset()
        self._begin()

    # ---- a step ----

    def _next_twist(self) -> tuple[Array, str]:
        """The twist for the limiter, and why it is less than what the phase wants ('' where it is not)."""
        try:
            self.before_phase()
            if self.current_phase and (phase := self.current_phase.interrupted()):
                self.enter(phase)
                self._wanted = np.zeros(6)
                return self._wanted, ""
            twist, waiting = self._watched_twist()
            return self.current_phase.adjust(twist, waiting) if self.current_phase else (twist, waiting)
        except PhaseFailed as failed:
            self._phase_failed(failed)
            self._wanted = np.zeros(6)
            return self._wanted, ""

    def _watched_twist(self) -> tuple[Array, str]:
        """The twist that the phase wants, as far as the age of its inputs allows it."""
        part = self.current_phase
        if part is None or self._waiting(part):
            self._wanted = np.zeros(6)
            return self._wanted, ""
        partner = "" if self.phase in (STOPPING, RETREAT) else self.partner
        stamps = {name: getattr(self, name).stamp_ns for name in part.inputs()}
        state = self.watchdog.step(self.now_ns, stamps, partner)
        self._lacks = self.explained(state.reason) if state.reason else ""
        reason = "; ".join(filter(None, (self._lacks, state.other)))
        if state.failed:
            self._fail_here(reason)
            return np.zeros(6), ""
        if not state.ok:
            return state.scale * self._wanted, reason
        if part.over():
            self.enter(part.next_phase())
            self._wanted = part.twist() if part.ends_moving else np.zeros(6)
        else:
            self._wanted = part.twist()
        return self._wanted, ""

    def _waiting(self, part: Phase[Any]) -> bool:
        """True while an input has yet to arrive for the first time; fails after a while."""
        missing, limit = part.missing(), self.watchdog.settings.start_timeout
        if missing and self.elapsed > limit:
            self._fail_here(self.explained(f"no {' and no '.join(missing)} has arrived within {limit:g} s"))
        return bool(missing)

    def explained(self, reason: str) -> str:
        """An input is missing: first why, as far as it is known."""
        return f"{self.remark}, so {reason}{self._refused}" if self.remark else reason + self._refused

    def _begin(self) -> None:
        if self.current_phase is not None:
            self.current_phase.begin()

    def _mind_pause(self, seconds: float) -> None:
        """After a time without a step the arm has stopped, and what it touched may be gone."""
        limit = max(self.watchdog.settings.patience, PAUSE)
        if seconds < 0.0:
            self._fail_here(f"the clock went back by {-seconds:.3f} s")
        elif seconds > limit:
            self._fail_here(f"the controller stood still for {seconds:.3f} s (limit {limit:g} s)")
        if seconds > PAUSE:
            self.limiter.reset()

    # ---- failing ----

    def fail(self, reason: str) -> None:
        """Fail, after leaving the surface."""
        self.reason = self.reason or reason
        self.enter(STOPPING)

    def _phase_failed(self, failed: PhaseFailed) -> None:
        """On the way off the surface that is told beside why it was to be left."""
        if self.phase in (STOPPING, RETREAT):
            self.reason = "; ".join(filter(None, (self.reason, failed.reason)))
            self._fail_here(self.reason)
        elif failed.here:
            self._fail_here(failed.reason)
        else:
            self.fail(failed.reason)

    def _fail_here(self, reason: str) -> None:
        """Fail where it stands: what is known does not allow to move."""
        if self.phase not in (DONE, FAILED):
            self.reason = self.reason or reason
            self.enter(FAILED)

    def _after_exception(self, error: Exception) -> Command:
        """Leave the surface if the task can still do that, else come to rest where it is."""
        text = told(error, type(self), f"{type(error).__name__} in phase {self.phase}: {error}")
        again, self.traceback = bool(self.traceback), self.traceback or traceback.format_exc()
        if again or self.phase in (STOPPING, RETREAT):
            self._fail_here(text)
        else:
            self.fail(text)
        self._wanted = np.zeros(6)
        try:
            return self._command(self._wanted, "")
        except Exception as last:  # nothing of the task works any more
            self._fail_here(told(last, type(self)))
            return self._said(self._wanted, "")

    # ---- what a step says ----

    def _command(self, wanted: Array, waiting: str) -> Command:
        """The twist for the limiter, and why it is not what the phase wants, with all else."""
        if not self.reason:
            self._progress = max(self._progress, 1.0 if self.phase == DONE else self.progress())
        return self._said(wanted, waiting, **self.details())

    def _said(self, wanted: Array, waiting: str, **details: Any) -> Command:
        limited = self.limiter.step(self.now_ns, wanted)
        over = self.phase in (DONE, FAILED)
        self._worked = self._worked or self.phase == self.work
        self.limited_by = limited.reason
        return self.command_class(
            twist=limited.twist,
            unlimited=self._wanted.copy(),
            phase=self.phase,
            done=over and self.at_rest,
            succeeded=self.phase == DONE,
            reason="; ".join(filter(None, (self.reason, waiting))),
            limited=limited.reason,
            progress=self._progress,
            travelled=self.odometer.length,
            at_work=self._worked and not over,
            trouble=self.reason or self._lacks,
            **details,
        )
