"""What a task is made of: its phases, what goes in, and what comes out. `phase_machine` runs them.

A `Phase` is a small object that says what inputs it needs, which twist it wants, when it is over and where it
leads. What every task has are `GoToPose` and `Stopping`; `contact_task` has those of tasks in contact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeGuard, TypeVar

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingGroups, Settings
from tactile_control.force_reference import StampedForce
from tactile_control.motion import TravelSettings, Waypoint, twist_towards, way_to_start
from tactile_geometry import se3

Array = NDArray[np.float64]

# phases of every task
GO_TO_START = "go_to_start"
STOPPING = "stopping"
RETREAT = "retreat"
DONE = "done"
FAILED = "failed"

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
class StampedImage:
    """A camera image (h, w) or (h, w, 3), uint8, and T_base_sensor (4, 4) at its exposure."""

    stamp_ns: int
    T_base_sensor: Array
    image: NDArray[np.uint8]


@dataclass(frozen=True)
class TaskInputs:
    """The latest of each input; None where none has arrived yet.

    `image` is for tasks that need images, `force` where the network tells it; `measured`, for tasks that need
    images, what a force sensor has said since the last step.
    """

    belief: StampedPose | None = None
    presence: StampedPresence | None = None
    sensor_pose: StampedPose | None = None
    image: StampedImage | None = None
    force: StampedForce | None = None
    measured: tuple[StampedForce, ...] = ()


class InputRefused(ValueError):
    """An input that counts as not come; the text says why."""


G = TypeVar("G", bound="Goal")
S = TypeVar("S", bound=SettingGroups)


@dataclass(frozen=True)
class Goal(Settings):
    """What one run of a task is to do, where its settings say how; each task has a class of its own."""

    def in_base(self: G, T_world_base: Array) -> G:
        """A copy with everything that is given in the world converted to the arm's base."""
        return self

    def adapted(self, settings: S) -> S:
        """The settings of the task with what the goal says in their place, such as a depth of its own.

        Called where the task begins and wherever its settings are replaced: nothing else need know of it.
        """
        return settings

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
    twist : (6,) [v, omega] in the controlled frame to send now: after watchdog and limiter
    unlimited : (6,) the same before watchdog and limiter
    phase : what the task does
    done, succeeded : the task is over and the twist is zero; whether it did what it was asked to
    reason : why it failed, is about to, or waits; '' where all is well
    limited : what the limiter held back in this step, '' for nothing: speeding up and braking are no trouble
    error, feedforward : (6,) what is left to correct (m, rad), and the part of the twist that does not come
        of it; NaN and zero
    reference : (6,) the contact pose that is servoed to, Euler (x, y, z, alpha, beta, gamma) of X_fs', m and
        rad; NaN
    progress : 0 to 1 over all phases; it never goes back
    travelled : way of the sensor's centre so far, m
    exposure_ns : stamp of the belief that the twist is based on, 0 for none
    at_work : its own phase (`PhaseMachine.work`) has begun, and it is not over
    hold : where it holds what it works at, in the world: the believed feature, T_world_feature; of an arm
        that feels nothing the controlled frame, T_world_tool
    trouble : why it does not go on with what it is for, to those who work together with it: something that
        it needs is missing or too old, or it ends before it has done it. '' also where it rests because of
        them.
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


class PhaseFailed(Exception):
    """Raised by a phase, with why the goal cannot be reached: the task leaves the surface and fails.

    `here`: it fails where it is, since what is known does not allow to move.
    """

    def __init__(self, reason: str, here: bool = False) -> None:
        super().__init__(reason)
        self.reason, self.here = reason, here


class PhasedTask(Protocol):
    """What a phase may ask of its task (`phase_machine.PhaseMachine` says what each is)."""

    settings: Any
    start: Array | None
    since_ns: int
    presence: StampedPresence | None
    T_begun: Array | None

    @property
    def elapsed(self) -> float: ...
    @property
    def T_base_sensor(self) -> Array: ...
    @property
    def at_rest(self) -> bool: ...
    @property
    def may_touch(self) -> bool: ...
    @property
    def meets_something(self) -> bool: ...
    @property
    def nothing_left(self) -> bool: ...
    @property
    def outcome(self) -> str: ...


T = TypeVar("T", bound=PhasedTask)


class Phase(Generic[T]):
    """What a task does for a while. One object lasts for the whole run, and may be entered again.

    Attributes
    ----------
    task : whose phase it is
    name : as the status tells it, one of the task's `phases`
    leads_to : the phase that follows when it is over
    needs : inputs without which it does not move, of "pose", "presence", "belief", "force"
    ends_moving : in the step in which it is over its twist is sent, not zero
    """

    name = leads_to = ""
    needs: tuple[str, ...] = ("pose", "presence")
    ends_moving = False

    def __init__(
        self, task: T, name: str = "", leads_to: str = "", needs: tuple[str, ...] | None = None
    ) -> None:
        self.task = task
        self.name, self.leads_to = name or self.name, leads_to or self.leads_to
        self.needs = self.needs if needs is None else needs

    def inputs(self) -> tuple[str, ...]:
        """What it needs now, with what settings may ask for besides."""
        return self.needs

    # ---- what a phase says; `over` and `twist` may raise `PhaseFailed` ----

    def begin(self) -> None:
        """It is entered: what it kept of the last time is forgotten."""

    def over(self) -> bool:
        """Whether it is over; asked once a step, before `twist`."""
        return False

    def twist(self) -> Array:
        """The twist (6,) wanted now, in the controlled frame, m/s and rad/s; at rest by default."""
        return np.zeros(6)

    def next_phase(self) -> str:
        """What follows; `leads_to` unless it depends on what has happened."""
        return self.leads_to

    def ahead(self) -> list[Array]:
        """For people: poses (4, 4) in the base that lead to its end, the last one there, as far as known."""
        return []

    def missing(self) -> list[str]:
        """What it needs and has yet to come."""
        return [name for name in self.inputs() if getattr(self.task, name) is None]

    def interrupted(self) -> str:
        """The phase to go to at once, whatever inputs are too old; '' to go on."""
        return ""

    def adjust(self, twist: Array, waiting: str) -> tuple[Array, str]:
        """What of a twist is to be followed, and why not all of it ('' for no reason)."""
        return twist, waiting

    # ---- what a phase knows ----

    @property
    def elapsed(self) -> float:
        """Seconds since it began."""
        return self.task.elapsed

    @property
    def T_base_sensor(self) -> Array:
        """The newest pose (4, 4) of the controlled frame in the base."""
        return self.task.T_base_sensor

    @property
    def touching(self) -> bool:
        """In contact, by an image exposed since it began."""
        presence = self.task.presence
        return presence is not None and presence.in_contact and presence.stamp_ns >= self.task.since_ns

    @property
    def moved(self) -> float:
        """Distance from where the sensor was when this was asked first in this phase, m."""
        if self.task.T_begun is None:
            self.task.T_begun = self.T_base_sensor.copy()
        return se3.norm(self.T_base_sensor[:3, 3] - self.task.T_begun[:3, 3])


class StraightTo(Phase[T]):
    """Straight to a pose in the base, slower near it; where that goes through the air nothing may be touched.

    `goal` gives the pose (4, 4), asked once each time that the phase begins, `pace` how fast, how near and
    how long; by default the task's start and its `travel` settings. `what` is the pose, as a message has it.
    """

    what, late, in_air = "the start", "was not reached within", True

    def __init__(
        self,
        task: T,
        *names: Any,
        goal: Callable[[], Array] | None = None,
        pace: Callable[[], TravelSettings] | None = None,
        what: str = "",
        **more: Any,
    ) -> None:
        super().__init__(task, *names, **more)
        self.goal: Callable[[], Any] = goal or (lambda: task.start)
        self.pace = pace or (lambda: task.settings.travel)
        self.what = what or self.what

    def begin(self) -> None:
        self.waypoints: list[Waypoint] | None = None

    def way(self) -> list[Waypoint]:
        """From where it begins."""
        pace = self.pace()
        return [Waypoint(self.goal(), pace.position_tolerance, pace.angle_tolerance)]

    def over(self) -> bool:
        if self.in_air and self.task.meets_something:
            raise PhaseFailed(f"touched something on the way to {self.what}")
        self.waypoints = self.way() if self.waypoints is None else self.waypoints
        while self.waypoints and self.waypoints[0].reached(self.T_base_sensor):
            self.waypoints.pop(0)
        if self.waypoints and self.elapsed > (limit := self.pace().timeout):
            raise PhaseFailed(f"{self.what} {self.late} {limit:g} s")
        return not self.waypoints

    def ahead(self) -> list[Array]:
        return [waypoint.T_base_goal for waypoint in self.waypoints or ()]

    def twist(self) -> Array:
        return twist_towards(self.T_base_sensor, (self.waypoints or self.way())[0].T_base_goal, self.pace())


class GoToPose(StraightTo[T]):
    """Through the air to a pose in the base: up along its -z, across, and down."""

    name = GO_TO_START
    needs: tuple[str, ...] = ("pose",)

    def way(self) -> list[Waypoint]:
        goal, pose, limit = self.goal(), self.T_base_sensor, self.pace().distance
        if (distance := se3.norm(goal[:3, 3] - pose[:3, 3])) > limit:
            raise PhaseFailed(f"{self.what} is {distance:.3g} m away (limit {limit:g} m)", here=True)
        return way_to_start(pose, goal, self.pace())


class LiftOff(StraightTo[T]):
    """Straight off the surface, which need not end exactly; then on, or to the end."""

    name = RETREAT
    needs: tuple[str, ...] = ("pose",)
    what, late, in_air = "the retreat", "took longer than", False
    near = 5e-4  # m

    def way(self) -> list[Waypoint]:
        return [Waypoint(self.goal(), self.near, np.inf)]

    def next_phase(self) -> str:
        return self.task.outcome if self.task.nothing_left else self.leads_to


class Stopping(Phase[T]):
    """To rest; then off the surface, if it may touch, and to the end."""

    name = STOPPING
    needs: tuple[str, ...] = ("pose",)

    def over(self) -> bool:
        return self.task.at_rest

    def next_phase(self) -> str:
        return RETREAT if self.task.may_touch else self.task.outcome
