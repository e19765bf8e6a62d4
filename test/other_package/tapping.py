"""Tapping: touch to a depth, hold, leave, step aside, again; a task with several phases of its own."""

from __future__ import annotations

from dataclasses import dataclass, field

from tactile_base.settings import Settings, setting
from tactile_control.contact_phases import APPROACH, INTO_CONTACT, Retreat, Servo
from tactile_control.contact_task import ContactTask, ContactTaskSettings
from tactile_control.phases import DONE, FAILED, RETREAT, STOPPING, Goal, StraightTo
from tactile_geometry import se3

HOLD, OFF, ASIDE = "hold", "off", "aside"


@dataclass(frozen=True)
class TappingSettings(Settings):
    """How it taps."""

    hold: float = setting(0.5, lower=0.0, upper=60.0, unit="s", doc="time at the depth")


@dataclass(frozen=True)
class TappingTaskSettings(ContactTaskSettings):
    """All settings of the control chain, and ours."""

    task: TappingSettings = field(default_factory=TappingSettings)


@dataclass(frozen=True)
class TappingGoal(Goal):
    """How deep, how often, and how far apart."""

    depth: float = setting(0.002, lower=0.0005, upper=0.01, unit="m", doc="of each tap")
    taps: int = setting(3, lower=1, upper=1000, doc="how many")
    aside: float = setting(
        0.005, lower=-0.1, upper=0.1, unit="m", doc="from one to the next, along the sensor's x"
    )

    def adapted(self, settings):
        """The depth is the goal's."""
        return settings.replaced(servoing__reference=(0.0, 0.0, self.depth, 0.0, 0.0, 0.0))


class Hold(Servo):
    """At the depth for a while; the last time it leads to the end."""

    def finished(self):
        return self.elapsed >= self.task.settings.task.hold

    def next_phase(self):
        self.task.tapped += 1
        return RETREAT if self.task.tapped == self.task.goal.taps else OFF


class Tapping(ContactTask):
    """Taps a surface in a row of places."""

    settings_class = TappingTaskSettings
    goal_class = TappingGoal
    work = HOLD
    phases = (*INTO_CONTACT, HOLD, OFF, ASIDE, STOPPING, RETREAT, DONE, FAILED)
    tapped = 0

    def own_phases(self):
        aside = StraightTo(self, ASIDE, APPROACH, goal=self.beside, what="the place of the next tap")
        return [Hold(self, HOLD), Retreat(self, OFF, ASIDE), aside]

    def beside(self):
        """The pose (4, 4) of the sensor a step along its x-axis from where it is."""
        return self.T_base_sensor @ se3.pose_from_euler([self.goal.aside, 0.0, 0.0, 0.0, 0.0, 0.0])

    def fraction(self):
        return self.tapped / self.goal.taps
