"""Move: an arm goes to a pose through the air: to a start, or out of the way."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings, setting
from tactile_base.stamps import NANOSECOND
from tactile_control.free_task import MOVE, FreeTask, FreeTaskSettings
from tactile_control.motion import pose_difference
from tactile_control.phases import DONE, GO_TO_START, Goal, GoToPose, PhaseFailed, TaskInputs
from tactile_geometry import se3

Array = NDArray[np.float64]

TOUCHED = "touched something on the way"
_RADIUS = 0.1  # m: a turn by an angle counts as much as this, turned by it
_LONGEST_STEP = 0.1  # s between two steps that counts; inputs were missing in a longer one


@dataclass(frozen=True)
class MoveSettings(Settings):
    """When a move is given up."""

    patience: float = setting(
        3.0, lower=0.1, upper=60.0, unit="s", doc="an arm that comes no nearer for so long is held back"
    )
    nearer: float = setting(
        0.0005, lower=1e-5, upper=0.01, unit="m", doc="way that counts as coming nearer; a rad as 0.1 m"
    )


@dataclass(frozen=True)
class MoveTaskSettings(FreeTaskSettings):
    """All settings of a move."""

    task: MoveSettings = field(default_factory=MoveSettings)


@dataclass(frozen=True)
class MoveGoal(Goal):
    """The pose of the controlled frame to go to."""

    position: tuple[float, ...] = setting(
        (), lower=-20.0, upper=20.0, unit="m", doc="of its origin in the arm's base, 3 numbers"
    )
    rotation_deg: tuple[float, ...] = setting(
        (), lower=-360.0, upper=360.0, unit="deg", doc="turns about fixed x, y, z of the base; none: as it is"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.position) != 3:
            raise SettingError(f"position: must have 3 elements, has {len(self.position)}")
        if len(self.rotation_deg) not in (0, 3):
            raise SettingError(f"rotation_deg: must have 0 or 3 elements, has {len(self.rotation_deg)}")

    @property
    def destination(self) -> tuple[float, ...]:
        """See `Goal`."""
        return self.position

    def pose_from(self, T_base_now: Array) -> Array:
        """The pose (4, 4) to go to, from where the frame is."""
        T = T_base_now.copy()
        if self.rotation_deg:
            T = se3.pose_from_euler([0.0, 0.0, 0.0, *np.radians(self.rotation_deg)])
        T[:3, 3] = self.position
        return T


class Go(GoToPose["Move"]):
    """To the goal's pose, as a task goes to its start; given up where the arm comes no nearer."""

    def __init__(self, task: Move) -> None:
        super().__init__(
            task, MOVE, DONE, goal=lambda: task.goal.pose_from(task.T_base_sensor), what="the pose"
        )
        self.begin()

    def begin(self) -> None:
        super().begin()
        self.whole, self.nearest = 0.0, np.inf  # m of way, at first and left at the least
        self.held_s, self.stepped_ns = 0.0, 0

    def over(self) -> bool:
        if super().over():
            return True
        settings, left, now_ns = self.task.settings.task, self._left(), self.task.now_ns
        self.whole = self.whole or left
        self.held_s += min((now_ns - self.stepped_ns) * NANOSECOND, _LONGEST_STEP)
        self.stepped_ns = now_ns
        if left < self.nearest - settings.nearer:
            self.nearest, self.held_s = left, 0.0
        if self.held_s > settings.patience:
            assert self.waypoints
            distance = se3.norm(self.waypoints[-1].T_base_goal[:3, 3] - self.T_base_sensor[:3, 3])
            raise PhaseFailed(
                f"the arm comes no nearer than {distance * 1e3:.1f} mm to the pose: limited_by of arm/status "
                "says what keeps it from there"
            )
        return False

    def _left(self) -> float:
        """Length of the way that is left, m."""
        at, way = self.T_base_sensor, 0.0
        for waypoint in self.waypoints or []:
            position, turn = pose_difference(at, waypoint.T_base_goal)
            way += se3.norm(position) + _RADIUS * se3.norm(turn)
            at = waypoint.T_base_goal
        return way


class Move(FreeTask):
    """Goes up along the pose's -z, across, and down, as a task does to its start (`motion.way_to_start`).

    An arm with a sensor comes to rest where it touches something; one that touches already may move away.
    """

    settings_class = MoveTaskSettings
    goal_class = MoveGoal
    monitors_contact = True

    settings: MoveTaskSettings
    goal: MoveGoal

    _free = _touched = False  # whether it was out of contact, and is in one since

    def move(self) -> Go:
        self._go = Go(self)
        return self._go

    def take(self, inputs: TaskInputs) -> None:
        super().take(inputs)
        if inputs.presence is not None:
            self._touched = self._touched or (self._free and inputs.presence.in_contact)
            self._free = self._free or not inputs.presence.in_contact

    def before_phase(self) -> None:
        if self._touched and self.phase in (GO_TO_START, MOVE):
            raise PhaseFailed(TOUCHED)

    def progress(self) -> float:
        """By the way that is left."""
        return max(0.0, 1.0 - self._go.nearest / self._go.whole) if self._go.whole else 0.0
