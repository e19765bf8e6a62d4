"""What tasks share that move an arm through the air and feel nothing: go to the start, move, stop."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingGroups
from tactile_control.limiter import LimiterSettings
from tactile_control.motion import Odometer, TravelSettings
from tactile_control.phases import (
    DONE,
    FAILED,
    GO_TO_START,
    STOPPING,
    Command,
    Goal,
    PhaseMachine,
    StampedPose,
    TaskInputs,
    newer,
)
from tactile_control.watchdog import WatchdogSettings
from tactile_geometry import se3

Array = NDArray[np.float64]

MOVE = "move"


@dataclass(frozen=True)
class FreeTaskSettings(SettingGroups):
    """Settings of every task that feels nothing."""

    travel: TravelSettings = field(default_factory=TravelSettings)
    limiter: LimiterSettings = field(default_factory=LimiterSettings)
    watchdog: WatchdogSettings = field(default_factory=WatchdogSettings)


class FreeTask(PhaseMachine[TaskInputs, Command]):
    """Base of tasks that feel nothing; a task adds `_move` and `_fraction`.

    Parameters
    ----------
    start : ndarray (4, 4), optional
        Where the move begins, in the base; without, where the arm stands.
    """

    phases: ClassVar[tuple[str, ...]] = (GO_TO_START, MOVE, STOPPING, DONE, FAILED)
    work = MOVE
    needs_sensor = False

    def __init__(self, settings: FreeTaskSettings, goal: Goal, start: Array | None = None) -> None:
        handlers = {GO_TO_START: self._go_to_start, MOVE: self._move, STOPPING: self._stopping}
        first = MOVE if start is None else GO_TO_START
        super().__init__(first, handlers, settings.limiter, settings.watchdog)
        self.settings = settings
        self.goal = goal
        self.start = None if start is None else se3.checked_pose("start", start)
        self._odometer = Odometer(1e-4)

    def configure(self, settings: FreeTaskSettings) -> None:
        """Replace the settings; they hold from the next step on."""
        self.settings = settings
        self.limiter.configure(settings.limiter)
        self.watchdog.configure(settings.watchdog)

    @abstractmethod
    def _move(self, now_ns: int) -> Array:
        """The twist wanted now; enters DONE, and wants none, at the end."""

    @abstractmethod
    def _fraction(self) -> float:
        """How much of the move is done, 0 to 1."""

    # ---- what a `PhaseMachine` fills in ----

    def _take(self, inputs: TaskInputs) -> None:
        if newer(inputs.sensor_pose, self._pose):
            se3.checked_pose("sensor pose", inputs.sensor_pose.T)
            self._pose = inputs.sensor_pose
            self._odometer.add(self._pose.T[:3, 3])

    def _stamps(self) -> dict[str, int | None]:
        return {"pose": self._pose.stamp_ns if self._pose is not None else None}

    def _go_to_start(self, now_ns: int) -> Array:
        assert self.start is not None
        twist = self._go_to(self.start, self.settings.travel, now_ns)
        if twist is None:
            self._waypoints = None  # the next way is another
            self._enter(MOVE)
            return np.zeros(6)
        return twist

    def _stopping(self, now_ns: int) -> Array:
        if self._at_rest():
            self._enter(FAILED if self.reason else DONE)
        return np.zeros(6)

    def _answer(self, wanted: Array, waiting: str) -> Command:
        common = vars(self._command(wanted, waiting))
        progress = 1.0 if self.phase == DONE else self._fraction()
        held = None
        if self._pose is not None and self.T_world_base is not None:
            held = StampedPose(self._pose.stamp_ns, se3.compose(self.T_world_base, self._pose.T))
        return Command(**common | {"progress": progress, "travelled": self._odometer.length, "hold": held})
