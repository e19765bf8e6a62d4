"""Touching: an arm touches a flat surface again and again, at tilts, and moves in each contact as it is told.

It gives what a cell is calibrated with (docs/own_cell.md). It relies on nothing that is calibrated: the arm
goes along paths of its own, and of the images it asks no more than whether there is contact.

Phases: go_to_start -> (over -> touch -> press -> retreat) for each touch -> done, or failed. All of it goes
by the frame of the start, whose z is taken to point into the surface.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, SettingGroups, Settings, setting
from tactile_base.stamps import NANOSECOND
from tactile_control.limiter import LimiterSettings
from tactile_control.motion import Odometer, TravelSettings, pose_difference, twist_towards
from tactile_control.phases import (
    DONE,
    FAILED,
    GO_TO_START,
    RETREAT,
    STOPPING,
    Command,
    Goal,
    PhaseMachine,
    StampedPresence,
    TaskInputs,
    newer,
)
from tactile_control.watchdog import WatchdogSettings
from tactile_geometry import se3

Array = NDArray[np.float64]

OVER = "over"
TOUCH = "touch"
PRESS = "press"
_NEAR = 1e-3  # m; a move through the air need not end more exactly than this
_TURNED = 2e-3  # rad; but its angles are those of the touch
_DIFFERENCE = 1e-3  # s, over which velocities of the path are differences
_EASE = 0.25  # of an oscillation's time, in which it grows, and in which it fades


@dataclass(frozen=True)
class TouchingSettings(Settings):
    """How fast the surface is touched, and from where."""

    clearance: float = setting(
        0.006, lower=1e-3, upper=0.1, unit="m", doc="gap to the surface between two touches"
    )
    search: float = setting(
        0.05, lower=1e-3, upper=0.5, unit="m", doc="without contact within this the task fails"
    )
    speed: float = setting(0.002, lower=1e-3, upper=0.02, unit="m/s", doc="speed of a touch")
    press_speed: float = setting(0.005, lower=1e-4, upper=0.05, unit="m/s", doc="speed from touch to depth")
    gain: float = setting(
        4.0, lower=0.0, upper=50.0, unit="1/s", doc="feedback: speed per distance from the path in contact"
    )
    lost_contact_time: float = setting(
        0.3, lower=0.0, upper=10.0, unit="s", doc="contact counts as lost when it was absent for this long"
    )


@dataclass(frozen=True)
class TouchingTaskSettings(SettingGroups):
    """All settings of touching."""

    task: TouchingSettings = field(default_factory=TouchingSettings)
    travel: TravelSettings = field(default_factory=TravelSettings)
    limiter: LimiterSettings = field(default_factory=LimiterSettings)
    watchdog: WatchdogSettings = field(default_factory=WatchdogSettings)


@dataclass(frozen=True)
class TouchingGoal(Goal):
    """Which touches, and what is done in each contact."""

    upright: int = setting(1, lower=0, upper=24, doc="touches as the start stands, on a circle about it")
    radius: float = setting(0.010, lower=0.0, upper=0.2, unit="m", doc="of that circle; one is at its centre")
    tilted: int = setting(0, lower=0, upper=48, doc="touches under a tilt, in directions all around")
    tilt_deg: float = setting(
        20.0, lower=1.0, upper=45.0, unit="deg", doc="tilt of every second of them; the others have half"
    )
    depth: float = setting(0.003, lower=0.0, upper=0.01, unit="m", doc="pressed from the touch to this depth")
    rest: float = setting(0.3, lower=0.0, upper=60.0, unit="s", doc="rest there")
    swing: tuple[float, ...] = setting(
        [0.0] * 6, length=6, lower=0.0, upper=[0.01] * 3 + [30.0] * 3, unit="m, deg",
        doc="amplitudes of oscillations about that depth along, then about x, y, z of the start's frame",
    )  # fmt: skip
    period: float = setting(1.0, lower=0.2, upper=60.0, unit="s", doc="of the oscillations, one at a time")
    periods: int = setting(10, lower=1, upper=1000, doc="of each of them")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.upright + self.tilted == 0:
            raise SettingError("upright and tilted are zero: there is nothing to touch")

    @property
    def touches(self) -> list[tuple[Array, Array]]:
        """Place (3,) m and tilt (3,), a rotation vector (rad), of each touch in the frame of the start."""
        spread = self.radius if self.upright > 1 else 0.0
        around = [2.0 * np.pi * k / max(self.upright, 1) for k in range(self.upright)]
        upright = [(spread * np.array([np.cos(a), np.sin(a), 0.0]), np.zeros(3)) for a in around]
        tilts = np.radians(self.tilt_deg) * np.where(np.arange(self.tilted) % 2 == 0, 1.0, 0.5)
        about = 2.0 * np.pi * np.arange(self.tilted) / max(self.tilted, 1)
        axes = np.column_stack([np.cos(about), np.sin(about), np.zeros(self.tilted)])
        return upright + [(np.zeros(3), tilt * axis) for tilt, axis in zip(tilts, axes, strict=True)]

    def offset(self, seconds: float) -> Array:
        """Displacement (m) and rotation vector (rad), (6,), of the oscillations after that time."""
        length, out = self.period * self.periods, np.zeros(6)
        swinging = np.flatnonzero(self.swing)
        turn = int(seconds // length)
        if 0 <= turn < len(swinging) and seconds >= 0.0:
            axis, part = swinging[turn], (seconds % length) / length
            ease = min(1.0, part / _EASE, (1.0 - part) / _EASE)
            wave = np.sin(2.0 * np.pi * self.periods * part) * ease * ease * (3.0 - 2.0 * ease)
            out[axis] = wave * (self.swing[axis] if axis < 3 else np.radians(self.swing[axis]))
        return out

    @property
    def swing_time(self) -> float:
        """Time that the oscillations take, s."""
        return self.period * self.periods * int(np.count_nonzero(self.swing))


class Touching(PhaseMachine[TaskInputs, Command]):
    """See the module's text.

    Parameters
    ----------
    start : ndarray (4, 4), optional
        T_base_sensor above the surface, z into it; without, where the arm stands.
    """

    settings_class = TouchingTaskSettings
    goal_class = TouchingGoal
    phases = (GO_TO_START, OVER, TOUCH, PRESS, STOPPING, RETREAT, DONE, FAILED)
    work = PRESS

    def __init__(
        self, settings: TouchingTaskSettings, goal: TouchingGoal, start: Array | None = None
    ) -> None:
        handlers = {
            GO_TO_START: self._go_to_start,
            OVER: self._over,
            TOUCH: self._touch,
            PRESS: self._press,
            STOPPING: self._stopping,
            RETREAT: self._retreat,
        }
        super().__init__(
            OVER if start is None else GO_TO_START, handlers, settings.limiter, settings.watchdog
        )
        self.settings = settings
        self.goal = goal
        self.T_base_start = None if start is None else se3.checked_pose("start", start)
        self._touches = goal.touches
        self._done = 0
        self._ends = False
        self._height: float | None = None  # z of the first touch in the frame of the start
        self._T_touched = np.eye(4)
        self._presence: StampedPresence | None = None
        self._seen_ns = 0  # when contact was seen last
        self._odometer = Odometer(1e-4)
        self._lifted: Array | None = None
        self._progress = 0.0

    def configure(self, settings: TouchingTaskSettings) -> None:
        """Replace the settings; they hold from the next step on."""
        self.settings = settings
        self.limiter.configure(settings.limiter)
        self.watchdog.configure(settings.watchdog)

    # ---- what a `PhaseMachine` fills in ----

    def _take(self, inputs: TaskInputs) -> None:
        if newer(inputs.sensor_pose, self._pose):
            self._pose = inputs.sensor_pose
            se3.checked_pose("sensor pose", self._pose.T)
            if self.T_base_start is None:
                self.T_base_start = self._pose.T.copy()
            self._odometer.add(self._pose.T[:3, 3])
        if newer(inputs.presence, self._presence):
            self._presence = inputs.presence
            if self._presence.in_contact:
                self._seen_ns = self._presence.stamp_ns

    def _stamps(self) -> dict[str, int | None]:
        stamps = {"pose": self._pose.stamp_ns if self._pose else None}
        if self.phase not in (RETREAT, STOPPING):
            stamps["presence"] = self._presence.stamp_ns if self._presence else None
        return stamps

    # ---- phases: each returns the twist wanted now ----

    def _go_to_start(self, now_ns: int) -> Array:
        assert self.T_base_start is not None
        if self._meets_something(now_ns):
            return self._fail("touched something on the way to the start")
        twist = self._go_to(self.T_base_start, self.settings.travel, now_ns)
        if twist is None:
            self._enter(OVER)
            return np.zeros(6)
        return twist

    def _over(self, now_ns: int) -> Array:
        """Over the place of the next touch, and tilted, in the air."""
        if self._meets_something(now_ns):
            gap = self.settings.task.clearance * 1e3
            return self._fail(f"touched something {gap:g} mm off the surface: set task.clearance")
        goal = self._above()
        position, rotation = pose_difference(self._sensor_pose(), goal)
        if np.linalg.norm(position) <= _NEAR and np.linalg.norm(rotation) <= _TURNED and self._at_ease():
            self._enter(TOUCH)
        elif self._in_phase(now_ns) > self.settings.travel.timeout:
            limit = self.settings.travel.timeout
            return self._fail(f"a place over the surface was not reached within {limit:g} s")
        return twist_towards(self._sensor_pose(), goal, self.settings.travel)

    def _touch(self, now_ns: int) -> Array:
        """Along the start's z until an image shows contact."""
        settings, above = self.settings.task, self._above()
        if self._touching():
            self._T_touched = self._sensor_pose().copy()
            if self._height is None:
                self._height = self._in_start(self._T_touched)[2]
            self._enter(PRESS)
            return np.zeros(6)
        search = settings.search if self._height is None else settings.clearance + settings.search / 5.0
        gone = self._in_start(self._sensor_pose())[2] - self._in_start(above)[2]
        if gone > search:
            return self._fail(f"no contact within {search * 1e3:.1f} mm over touch {self._done + 1}")
        goal = above.copy()
        goal[:3, 3] += self._z() * 2.0 * settings.search
        return twist_towards(self._sensor_pose(), goal, self.settings.travel.replaced(speed=settings.speed))

    def _press(self, now_ns: int) -> Array:
        """To the depth, through the oscillations, and a rest."""
        goal, settings = self.goal, self.settings.task
        elapsed = self._in_phase(now_ns)
        if elapsed > goal.depth / settings.press_speed and self._lost():
            return self._fail(f"contact was lost in touch {self._done + 1}")
        if elapsed >= self._press_time:
            self._done += 1
            self._enter(RETREAT)
            return np.zeros(6)
        wanted = self._on_path(elapsed)
        ahead, behind = self._on_path(elapsed + _DIFFERENCE), self._on_path(elapsed - _DIFFERENCE)
        X_error = se3.inverse(self._sensor_pose()) @ wanted
        twist = se3.log(se3.inverse(behind) @ ahead) / (2.0 * _DIFFERENCE)
        return np.asarray(se3.adjoint(X_error) @ twist + settings.gain * se3.log(X_error))

    def _retreat(self, now_ns: int) -> Array:
        """Straight off the surface; the last time to the height of the start."""
        ends = self._ends or bool(self.reason) or self._done == len(self._touches)
        if self._lifted is None:
            z = 0.0 if ends or self._height is None else self._height - self.settings.task.clearance
            self._lifted = self._sensor_pose().copy()
            self._lifted[:3, 3] += self._z() * min(0.0, z - self._in_start(self._lifted)[2])
        position, _ = pose_difference(self._sensor_pose(), self._lifted)
        if np.linalg.norm(position) <= _NEAR:
            self._enter(FAILED if self.reason else DONE if ends else OVER)
            return np.zeros(6)
        if self._in_phase(now_ns) > self.settings.travel.timeout:
            return self._retreat_late(self.settings.travel.timeout)
        return twist_towards(self._sensor_pose(), self._lifted, self.settings.travel)

    def _stopping(self, now_ns: int) -> Array:
        self._ends = True
        if self._at_rest():
            self._enter(RETREAT)
        return np.zeros(6)

    # ---- parts of phases ----

    def _enter(self, phase: str) -> None:
        super()._enter(phase)
        self._lifted = None

    @property
    def _press_time(self) -> float:
        """From a touch to leaving the surface, s."""
        return self.goal.depth / self.settings.task.press_speed + self.goal.rest + self.goal.swing_time

    def _on_path(self, elapsed: float) -> Array:
        """Where the sensor is to be (4, 4) that long after its touch, s."""
        assert self.T_base_start is not None
        speed, R = self.settings.task.press_speed, self.T_base_start[:3, :3]
        offset = self.goal.offset(elapsed - self.goal.depth / speed - self.goal.rest)
        offset[2] += min(self.goal.depth, max(0.0, elapsed * speed))
        T = self._T_touched.copy()
        T[:3, 3] += R @ offset[:3]
        T[:3, :3] = se3.exp(np.concatenate([np.zeros(3), R @ offset[3:]]))[:3, :3] @ T[:3, :3]
        return T

    def _above(self) -> Array:
        """Where the next touch begins (4, 4): at the start's height, later a little over the surface."""
        assert self.T_base_start is not None
        place, tilt = self._touches[self._done]
        X = se3.exp(np.concatenate([np.zeros(3), tilt]))
        X[:3, 3] = place
        X[2, 3] = 0.0 if self._height is None else self._height - self.settings.task.clearance
        return np.asarray(self.T_base_start @ X)

    def _in_start(self, T: Array) -> Array:
        """Position (3,) in the frame of the start, m."""
        assert self.T_base_start is not None
        return np.asarray(self.T_base_start[:3, :3].T @ (T[:3, 3] - self.T_base_start[:3, 3]))

    def _z(self) -> Array:
        assert self.T_base_start is not None
        return np.asarray(self.T_base_start[:3, 2])

    def _touching(self) -> bool:
        """In contact, by an image exposed since this phase began."""
        return self._seen_ns >= self._phase_since_ns

    def _at_ease(self) -> bool:
        """The images show no contact any more: the skin has come back."""
        presence = self._presence
        return presence is not None and not presence.in_contact and presence.stamp_ns >= self._phase_since_ns

    def _meets_something(self, now_ns: int) -> bool:
        """Contact where there should be air, for longer than a skin that comes back explains."""
        return self._touching() and self._in_phase(now_ns) > self.settings.task.lost_contact_time

    def _lost(self) -> bool:
        presence = self._presence
        assert presence is not None
        return (presence.stamp_ns - self._seen_ns) * NANOSECOND > self.settings.task.lost_contact_time

    def _answer(self, wanted: Array, waiting: str) -> Command:
        pressed = self._in_phase(self._now_ns or 0) / self._press_time if self.phase == PRESS else 0.0
        self._progress = max(self._progress, (self._done + min(pressed, 1.0)) / len(self._touches))
        more = {"progress": self._progress, "travelled": self._odometer.length}
        return Command(**{**vars(self._command(wanted, waiting)), **more})
