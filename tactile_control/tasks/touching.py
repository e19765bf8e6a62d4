"""Touching: an arm touches a flat surface again and again, at tilts, and moves in each contact as it is told.

It gives what a cell is calibrated with (docs/own_cell.md). It relies on nothing that is calibrated: the arm
goes along paths of its own, and of the images it asks no more than whether there is contact.

Phases: go_to_start -> (over -> touch -> press -> retreat) for each touch -> done, or failed. All of it goes
by the frame of the start, whose z is taken to point into the surface.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings, setting
from tactile_base.stamps import NANOSECOND
from tactile_control.free_task import FreeTaskSettings
from tactile_control.motion import TravelSettings, Waypoint, path_twist
from tactile_control.phase_machine import PhaseMachine
from tactile_control.phases import (
    DONE,
    FAILED,
    GO_TO_START,
    RETREAT,
    STOPPING,
    Goal,
    GoToPose,
    LiftOff,
    Phase,
    PhaseFailed,
    Stopping,
    StraightTo,
    TaskInputs,
    newer,
)
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
class TouchingTaskSettings(FreeTaskSettings):
    """All settings of touching."""

    task: TouchingSettings = field(default_factory=TouchingSettings)


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


class Over(StraightTo["Touching"]):
    """Over the place of the next touch, and tilted, in the air, until the skin has come back."""

    ends_moving = True

    def way(self) -> list[Waypoint]:
        return [Waypoint(self.goal(), _NEAR, _TURNED)]

    def over(self) -> bool:
        if self.task.meets_something:
            gap = self.task.settings.task.clearance * 1e3
            raise PhaseFailed(f"touched something {gap:g} mm off the surface: set task.clearance")
        presence = self.task.presence
        at_ease = presence is not None and not presence.in_contact and presence.stamp_ns >= self.task.since_ns
        return super().over() and at_ease


class Touch(StraightTo["Touching"]):
    """Along the start's z until an image shows contact."""

    def over(self) -> bool:
        task, settings = self.task, self.task.settings.task
        if self.touching:
            task.T_touched = self.T_base_sensor.copy()
            task.height = task.z_in_start(task.T_touched) if task.height is None else task.height
            return True
        search = settings.search if task.height is None else settings.clearance + settings.search / 5.0
        if task.z_in_start(self.T_base_sensor) - task.z_in_start(task.above(0.0)) > search:
            raise PhaseFailed(f"no contact within {search * 1e3:.1f} mm over touch {task.done + 1}")
        return False


class Press(Phase["Touching"]):
    """To the depth, through the oscillations, and a rest."""

    def over(self) -> bool:
        task, pressed_s = self.task, self.task.goal.depth / self.task.settings.task.press_speed
        assert task.presence is not None
        absent = (task.presence.stamp_ns - task.seen_ns) * NANOSECOND
        if self.elapsed > pressed_s and absent > task.settings.task.lost_contact_time:
            raise PhaseFailed(f"contact was lost in touch {task.done + 1}")
        if self.elapsed < task.press_time:
            return False
        task.done += 1
        return True

    def twist(self) -> Array:
        own, error = path_twist(self._on_path, self.elapsed, 1.0, _DIFFERENCE, self.T_base_sensor)
        return np.asarray(own + self.task.settings.task.gain * error)

    def _on_path(self, elapsed: float) -> Array:
        """Where the sensor is to be (4, 4) that long after its touch, s."""
        goal, speed, R = self.task.goal, self.task.settings.task.press_speed, self.task.T_base_start[:3, :3]
        offset = goal.offset(elapsed - goal.depth / speed - goal.rest)
        offset[2] += min(goal.depth, max(0.0, elapsed * speed))
        T = self.task.T_touched.copy()
        T[:3, 3] += R @ offset[:3]
        T[:3, :3] = se3.exp(np.concatenate([np.zeros(3), R @ offset[3:]]))[:3, :3] @ T[:3, :3]
        return T


class Touching(PhaseMachine):
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

    settings: TouchingTaskSettings
    goal: TouchingGoal

    def __init__(
        self, settings: TouchingTaskSettings, goal: TouchingGoal, start: Array | None = None
    ) -> None:
        super().__init__(settings, goal, start)
        self.touches, self.done = goal.touches, 0
        self.height: float | None = None  # z of the first touch in the frame of the start
        self.T_touched = np.eye(4)
        self.seen_ns = 0  # when contact was seen last

    def make_phases(self) -> Iterable[Phase[Any]]:
        def slow() -> TravelSettings:
            return self.settings.travel.replaced(speed=self.settings.task.speed)

        return (
            GoToPose(self, leads_to=OVER, needs=("pose", "presence")),
            Over(self, OVER, TOUCH, goal=lambda: self.above(0.0), what="a place over the surface"),
            Touch(self, TOUCH, PRESS, goal=lambda: self.above(2.0 * self.settings.task.search), pace=slow),
            Press(self, PRESS, RETREAT),
            Stopping(self),
            LiftOff(self, RETREAT, OVER, goal=self._lifted),
        )

    def first_phase(self) -> str:
        return OVER if self.start is None else GO_TO_START

    def take(self, inputs: TaskInputs) -> None:
        super().take(inputs)
        if self.start is None and self.pose is not None:
            self.start = self.pose.T.copy()
        if newer(inputs.presence, self.presence):
            self.presence = inputs.presence
            self.seen_ns = self.presence.stamp_ns if self.presence.in_contact else self.seen_ns

    @property
    def meets_something(self) -> bool:
        """For longer than a skin that comes back explains."""
        return self.seen_ns >= self.since_ns and self.elapsed > self.settings.task.lost_contact_time

    @property
    def nothing_left(self) -> bool:
        """Nothing is left to touch, or it is left out."""
        return super().nothing_left or self.done == len(self.touches)

    def progress(self) -> float:
        """By touches done, and the time of the one under way."""
        pressed = self.elapsed / self.press_time if self.phase == PRESS else 0.0
        return (self.done + min(pressed, 1.0)) / len(self.touches)

    # ---- what its phases share ----

    @property
    def T_base_start(self) -> Array:
        """The start (4, 4), by which all goes."""
        assert self.start is not None
        return self.start

    @property
    def press_time(self) -> float:
        """From a touch to leaving the surface, s."""
        return self.goal.depth / self.settings.task.press_speed + self.goal.rest + self.goal.swing_time

    def z_in_start(self, T: Array) -> float:
        """How far along the start's z a pose lies, m."""
        return float((self.T_base_start[:3, :3].T @ (T[:3, 3] - self.T_base_start[:3, 3]))[2])

    def above(self, further: float) -> Array:
        """Where the next touch begins (4, 4), and `further` (m) along the start's z.

        It begins at the start's height, later a little over the surface.
        """
        place, tilt = self.touches[self.done]
        X = se3.exp(np.concatenate([np.zeros(3), tilt]))
        X[:3, 3] = place
        X[2, 3] = 0.0 if self.height is None else self.height - self.settings.task.clearance
        T = np.asarray(self.T_base_start @ X)
        T[:3, 3] += self.T_base_start[:3, 2] * further
        return T

    def _lifted(self) -> Array:
        """Straight off the surface from where it is; the last time to the height of the start."""
        z = 0.0 if self.nothing_left or self.height is None else self.height - self.settings.task.clearance
        T = self.T_base_sensor.copy()
        T[:3, 3] += self.T_base_start[:3, 2] * min(0.0, z - self.z_in_start(T))
        return T
