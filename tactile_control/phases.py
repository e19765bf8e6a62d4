"""PhaseMachine: what tasks have in common that move the sensor phase by phase, one twist a step.

A step takes in what has come, lets the watchdog look at the age of what the phase needs, and asks the phase
for the twist that it wants; what goes out has passed the watchdog's ramp and the limiter. An input that is
too old takes the twist to zero. The task goes on when it is back; after the watchdog's patience it fails
where it is, since an arm that cannot feel or does not know where it is does not move; so it does when nobody
has made a step for as long. Every other failure leaves the surface first, an exception in the task, too.
"""

from __future__ import annotations

import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Generic, Protocol, TypeGuard, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from tactile_base.raised import told
from tactile_base.settings import SettingGroups, Settings
from tactile_base.stamps import NANOSECOND
from tactile_control.limiter import LimiterSettings, TwistLimiter
from tactile_control.motion import TravelSettings, Waypoint, twist_towards, way_to_start
from tactile_control.watchdog import Watchdog, WatchdogSettings
from tactile_geometry import se3
from tactile_geometry.se3 import PoseError

Array = NDArray[np.float64]

# phases of every task
GO_TO_START = "go_to_start"
STOPPING = "stopping"
RETREAT = "retreat"
DONE = "done"
FAILED = "failed"

AT_REST = 1e-6  # m/s and rad/s
PAUSE = 0.2  # s without a step, after which the arm has stopped by itself: the twist begins at zero again
_NOT_KNOWN, _NOTHING = np.full(6, np.nan), np.zeros(6)  # shared by commands: nobody writes to them
for _shared in (_NOT_KNOWN, _NOTHING):
    _shared.setflags(write=False)


@dataclass(frozen=True)
class StampedPose:
    """A pose (4, 4) with the instant it holds for: a belief's mean X_sf, or T_base_sensor."""

    stamp_ns: int
    T: Array


@dataclass(frozen=True)
class StampedPresence:
    """Whether the sensor touches, at the exposure's stamp, and whether images show nothing but noise."""

    stamp_ns: int
    in_contact: bool
    still: bool = False


@dataclass(frozen=True)
class TaskInputs:
    """The latest of each input; None where none has arrived yet."""

    belief: StampedPose | None = None
    presence: StampedPresence | None = None
    sensor_pose: StampedPose | None = None


G = TypeVar("G", bound="Goal")


@dataclass(frozen=True)
class Goal(Settings):
    """What one run of a task is to do, where its settings say how; each task has a class of its own."""

    def in_base(self: G, T_world_base: Array) -> G:
        """The same goal with all that it gives in the world in the arm's base, which stands there."""
        return self

    @property
    def destination(self) -> tuple[float, ...]:
        """Where the controlled frame's origin is to go, in the base (3), m; empty: not known beforehand."""
        return ()

    @property
    def ends(self) -> bool:
        """Whether it is reached some time, without being asked to finish."""
        return True


@dataclass(frozen=True)
class Command:
    """What one step of a task says; `error` to `exposure_ns` say nothing where there is no such thing.

    Attributes
    ----------
    twist : ndarray (6,)
        [v, omega] in the controlled frame to send now: after watchdog and limiter.
    unlimited : ndarray (6,)
        The same before watchdog and limiter.
    phase : str
        What the task does.
    done, succeeded : bool
        The task is over and the twist is zero; whether it did what it was asked to.
    reason : str
        Why it failed, is about to, or waits; '' where all is well.
    limited : str
        What the limiter held back in this step, '' for nothing: speeding up and braking are no trouble.
    error, feedforward : ndarray (6,)
        What is left to correct (m, rad) and the part of the twist that does not come of it; NaN and zero.
    reference : ndarray (6,)
        The contact pose that is servoed to, Euler (x, y, z, alpha, beta, gamma) of X_fs', m and rad; NaN.
    progress : float
        0 to 1 over all phases; it never goes back.
    travelled : float
        Way of the sensor's centre so far, m.
    exposure_ns : int
        Stamp of the belief that the twist is based on, 0 for none.
    at_work : bool
        Its own phase (`PhaseMachine.work`) has begun, and it is not over.
    hold : StampedPose or None
        Where it holds what it works at, in the world: the believed feature, T_world_feature; of an arm that
        feels nothing the controlled frame, T_world_tool.
    trouble : str
        Why it does not go on with what it is for, to those who work together with it: something that it
        needs is missing or too old, or it ends before it has done it. '' also where it rests because of them.
    """

    twist: Array
    unlimited: Array
    phase: str
    done: bool
    succeeded: bool
    reason: str
    limited: str
    error: Array = field(default_factory=lambda: _NOT_KNOWN)
    feedforward: Array = field(default_factory=lambda: _NOTHING)
    reference: Array = field(default_factory=lambda: _NOT_KNOWN)
    progress: float = 0.0
    travelled: float = 0.0
    exposure_ns: int = 0
    at_work: bool = False
    trouble: str = ""
    hold: StampedPose | None = None

    @property
    def over(self) -> bool:
        """Whether it has come to its end, if not to rest."""
        return self.phase in (DONE, FAILED)


class Stamped(Protocol):
    """Something of an instant."""

    @property
    def stamp_ns(self) -> int:
        """The instant, ns."""


Item = TypeVar("Item", bound=Stamped)


def newer(value: Item | None, last: Item | None) -> TypeGuard[Item]:
    """Whether there is a value, later than the last one."""
    return value is not None and (last is None or value.stamp_ns > last.stamp_ns)


Inputs = TypeVar("Inputs")
Result = TypeVar("Result", bound=Command)


class PhaseMachine(ABC, Generic[Inputs, Result]):
    """Base of tasks; see the module's text. One object runs one goal.

    Parameters
    ----------
    phase : str
        The first phase.
    handlers : mapping
        By phase, what returns the twist (6,) wanted now, given the time (ns); DONE and FAILED want none.
    limiter, watchdog
        Their settings.

    Attributes
    ----------
    settings_class, goal_class
        What can be set of the task, and what a goal says.
    phases : tuple of str
        Names of its phases, for people, in their usual order.
    work : str
        The one of them in which it does what it is for.
    node : str
        Which node runs it.
    needs_sensor : bool
        Whether it needs a tactile sensor.
    monitors_contact : bool
        Whether it wants to know of a contact where the arm has a sensor, though it needs none.
    endless : bool
        Whether it goes on until it is asked to `finish`.
    traceback : str
        Where an exception in the task came from; '' for none.
    remark : str
        What whoever calls knows of inputs that do not come; it is told where one is missing or too old.
    T_world_base : ndarray (4, 4) or None
        Where the arm's base stands; None: not known.
    partner_hold : StampedPose or None
        The newest `Command.hold` of another arm that works on the same object.
    partner : str
        Why another arm that works on the same object does not go on (`partners`); as long as it says so this
        one rests too, as when an input is missing. It does not keep the task from leaving the surface.
    """

    settings_class: ClassVar[type[SettingGroups]]
    goal_class: ClassVar[type[Goal]] = Goal
    phases: ClassVar[tuple[str, ...]]
    work: ClassVar[str]
    node: ClassVar[str] = "controller"
    needs_sensor: ClassVar[bool] = True
    monitors_contact: ClassVar[bool] = False
    endless: ClassVar[bool] = False

    def __init__(
        self,
        phase: str,
        handlers: Mapping[str, Callable[[int], Array]],
        limiter: LimiterSettings,
        watchdog: WatchdogSettings,
    ) -> None:
        self.phase = phase
        self.reason = self.traceback = ""
        self.limiter = TwistLimiter(limiter)
        self.watchdog = Watchdog(watchdog)
        self._handlers = handlers
        self._now_ns: int | None = None
        self._phase_since_ns = 0
        self._pose: StampedPose | None = None
        self._wanted = np.zeros(6)
        self._refused = self._lacks = ""
        self._begun = False
        self.remark = self.partner = ""
        self.T_world_base: Array | None = None
        self.partner_hold: StampedPose | None = None
        self._waypoints: list[Waypoint] | None = None

    # ---- what the owner calls ----

    @abstractmethod
    def configure(self, settings: Any) -> None:
        """Replace the settings, of `settings_class`; they hold from the next step on."""

    def finish(self) -> None:
        """Ask the task to end as if its goal had been reached: it comes to rest and leaves the surface."""
        if self.phase not in (DONE, FAILED, STOPPING, RETREAT):
            self._enter(STOPPING)

    def stop(self, reason: str) -> None:
        """Ask the task to end: it comes to rest, leaves the surface if it may touch, fails with `reason`."""
        if self.phase in (DONE, FAILED, STOPPING) or self.reason:
            return
        self.reason = reason or "stopped"
        self._enter(RETREAT if self.phase == RETREAT else STOPPING)

    def abort(self, reason: str) -> None:
        """End where it is, coming to rest: the arm does not follow."""
        self._fail_here(reason)

    def step(self, now_ns: int, inputs: Inputs) -> Result:
        """Advance to `now_ns` with the latest inputs. Nothing raises: what is wrong fails the task."""
        if self._now_ns is None:
            self._phase_since_ns = now_ns
        else:
            self._mind_pause((now_ns - self._now_ns) * NANOSECOND)
        self._now_ns = now_ns
        self._refused = self._lacks = ""
        try:
            self._take(inputs)
        except PoseError as error:
            self._refused = f" (the last one was refused: {error})"
        try:
            return self._answer(*self._next_twist(now_ns))
        except Exception as error:
            return self._after_exception(error)

    def _mind_pause(self, seconds: float) -> None:
        """After a time without a step the arm has stopped, and what it touched may be gone."""
        limit = max(self.watchdog.settings.patience, PAUSE)
        if seconds < 0.0:
            self._fail_here(f"the clock went back by {-seconds:.3f} s")
        elif seconds > limit:
            self._fail_here(f"the controller stood still for {seconds:.3f} s (limit {limit:g} s)")
        if seconds > PAUSE:
            self.limiter.reset()

    def _after_exception(self, error: Exception) -> Result:
        """Leave the surface if the task can still do that, else come to rest where it is."""
        text = told(error, type(self), f"{type(error).__name__} in phase {self.phase}: {error}")
        again, self.traceback = bool(self.traceback), self.traceback or traceback.format_exc()
        if again or self.phase in (STOPPING, RETREAT):
            self._fail_here(text)
        else:
            self._fail(text)
        self._wanted = np.zeros(6)
        try:
            return self._answer(self._wanted, "")
        except Exception as last:  # nothing of the task works any more
            self._fail_here(told(last, type(self)))
            return cast(Result, self._command(self._wanted, ""))

    # ---- what a task fills in ----

    @abstractmethod
    def _take(self, inputs: Inputs) -> None:
        """Keep each input if it is later than the last; `PoseError` for one that counts as not come."""

    @abstractmethod
    def _stamps(self) -> dict[str, int | None]:
        """Stamps of what this phase needs, by the watchdog's names; None: none has come yet."""

    @abstractmethod
    def _answer(self, wanted: Array, waiting: str) -> Result:
        """What the step says: a twist for the limiter, and what the watchdog complains about."""

    def _missing(self) -> list[str]:
        """What this phase needs and has yet to come."""
        return [name for name, stamp in self._stamps().items() if stamp is None]

    # ---- what a task uses ----

    def _next_twist(self, now_ns: int) -> tuple[Array, str]:
        """The twist for the limiter, and why it is less than what the phase wants ('' where it is not)."""
        if self.phase in (DONE, FAILED) or self._waiting(now_ns):
            self._wanted = np.zeros(6)
            return self._wanted, ""
        partner = "" if self.phase in (STOPPING, RETREAT) else self.partner
        state = self.watchdog.step(now_ns, self._stamps(), partner)
        self._lacks = self._explained(state.reason) if state.reason else ""
        reason = "; ".join(filter(None, (self._lacks, state.other)))
        if state.failed:
            self._fail_here(reason)
            return np.zeros(6), ""
        if not state.ok:
            return state.scale * self._wanted, reason
        self._wanted = self._handlers[self.phase](now_ns)
        return self._wanted, ""

    def _waiting(self, now_ns: int) -> bool:
        """True while an input has yet to arrive for the first time; fails after a while."""
        missing, limit = self._missing(), self.watchdog.settings.start_timeout
        if missing and self._in_phase(now_ns) > limit:
            self._fail_here(self._explained(f"no {' and no '.join(missing)} has arrived within {limit:g} s"))
        return bool(missing)

    def _explained(self, reason: str) -> str:
        """An input is missing: first why, as far as it is known."""
        return f"{self.remark}, so {reason}{self._refused}" if self.remark else reason + self._refused

    def _enter(self, phase: str) -> None:
        self.phase = phase
        self._phase_since_ns = self._now_ns or 0
        self.watchdog.reset()

    def _go_to(
        self, T_base_goal: Array, travel: TravelSettings, now_ns: int, name: str = "start"
    ) -> Array | None:
        """The twist on the way to a pose in the air, None once there; fails if it is far or takes long."""
        pose = self._sensor_pose()
        if self._waypoints is None:
            if (way := se3.norm(T_base_goal[:3, 3] - pose[:3, 3])) > travel.distance:
                self._fail_here(f"the {name} is {way:.3g} m away (limit {travel.distance:g} m)")
                return np.zeros(6)
            self._waypoints = way_to_start(pose, T_base_goal, travel)
        if self._in_phase(now_ns) > travel.timeout:
            return self._fail(f"the {name} was not reached within {travel.timeout:g} s")
        while self._waypoints and self._waypoints[0].reached(pose):
            self._waypoints.pop(0)
        return twist_towards(pose, self._waypoints[0].T_base_goal, travel) if self._waypoints else None

    def _in_phase(self, now_ns: int) -> float:
        """Seconds since this phase began."""
        return (now_ns - self._phase_since_ns) * NANOSECOND

    def _sensor_pose(self) -> Array:
        assert self._pose is not None
        return self._pose.T

    def _fail(self, reason: str) -> Array:
        """Fail, after leaving the surface."""
        self.reason = self.reason or reason
        self._enter(STOPPING)
        return np.zeros(6)

    def _fail_here(self, reason: str) -> None:
        """Fail where it stands: what is known does not allow to move."""
        if self.phase not in (DONE, FAILED):
            self.reason = self.reason or reason
            self._enter(FAILED)

    def _retreat_late(self, limit: float) -> Array:
        """Give up leaving the surface, which is told beside why it was to be left."""
        late = f"the retreat took longer than {limit:g} s"
        self.reason = "; ".join(filter(None, (self.reason, late)))
        self._enter(FAILED)
        return np.zeros(6)

    def _at_rest(self) -> bool:
        """Whether the twist sent last was zero."""
        return bool(np.abs(self.limiter.twist).max() <= AT_REST)

    def _command(self, wanted: Array, waiting: str, **more: Any) -> Command:
        """What all tasks say, and what this one says more."""
        assert self._now_ns is not None
        limited = self.limiter.step(self._now_ns, wanted)
        over = self.phase in (DONE, FAILED)
        self._begun = self._begun or self.phase == self.work
        return Command(
            twist=limited.twist,
            unlimited=self._wanted.copy(),
            phase=self.phase,
            done=over and self._at_rest(),
            succeeded=self.phase == DONE,
            reason="; ".join(filter(None, (self.reason, waiting))),
            limited=limited.reason,
            at_work=self._begun and not over,
            trouble=self.reason or self._lacks,
            **more,
        )
