"""What tasks share that move an arm through the air and feel nothing: go to the start, move, stop."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from tactile_base.settings import SettingGroups
from tactile_control.limiter import LimiterSettings
from tactile_control.motion import TravelSettings
from tactile_control.phase_machine import PhaseMachine
from tactile_control.phases import DONE, FAILED, GO_TO_START, STOPPING, GoToPose, Phase, StampedPose, Stopping
from tactile_control.watchdog import WatchdogSettings
from tactile_geometry import se3

MOVE = "move"


@dataclass(frozen=True)
class FreeTaskSettings(SettingGroups):
    """Settings of every task that feels nothing."""

    travel: TravelSettings = field(default_factory=TravelSettings)
    limiter: LimiterSettings = field(default_factory=LimiterSettings)
    watchdog: WatchdogSettings = field(default_factory=WatchdogSettings)


class FreeTask(PhaseMachine):
    """Base of tasks that feel nothing; a task adds the phase MOVE."""

    phases = (GO_TO_START, MOVE, STOPPING, DONE, FAILED)
    work = MOVE
    needs_sensor = False

    @abstractmethod
    def move(self) -> Phase[Any]:
        """The phase MOVE, which leads to DONE."""

    def make_phases(self) -> Iterable[Phase[Any]]:
        return GoToPose(self, leads_to=MOVE), self.move(), Stopping(self)

    def details(self) -> dict[str, Any]:
        """What it carries is held by the controlled frame."""
        if self.pose is None or self.T_world_base is None:
            return {}
        return {"hold": StampedPose(self.pose.stamp_ns, se3.compose(self.T_world_base, self.pose.T))}
