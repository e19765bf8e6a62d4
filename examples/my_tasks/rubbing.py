"""Rubbing to and fro over a surface, for a number of strokes."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from tactile_base.settings import Settings, setting
from tactile_control.contact_phases import INTO_CONTACT
from tactile_control.contact_task import ContactTask, ContactTaskSettings
from tactile_control.phases import DONE, FAILED, RETREAT, STOPPING, Goal
from tactile_records.runs import surface_following


@dataclass(frozen=True)
class RubbingSettings(Settings):
    """How it rubs."""

    speed: float = setting(0.02, lower=0.0, upper=0.2, unit="m/s", doc="largest speed of a stroke")


@dataclass(frozen=True)
class RubbingTaskSettings(ContactTaskSettings):
    """All settings of the control chain, and ours."""

    task: RubbingSettings = field(default_factory=RubbingSettings)


@dataclass(frozen=True)
class RubbingGoal(Goal):
    """Where and how often."""

    direction_deg: float = setting(
        90.0, lower=-360.0, upper=360.0, unit="deg", doc="in the reference's xy-plane"
    )
    length: float = setting(0.02, lower=1e-3, upper=0.5, unit="m", doc="way of a stroke")
    strokes: int = setting(4, lower=1, upper=1000, doc="how many, each the other way")


class Rubbing(ContactTask):
    """Rubs to and fro over a surface."""

    settings_class = RubbingTaskSettings
    goal_class = RubbingGoal
    work = "rub"
    phases = (*INTO_CONTACT, "rub", STOPPING, RETREAT, DONE, FAILED)

    def _stroke_time(self) -> float:
        """Of a stroke whose speed goes as a half sine, s."""
        return 0.5 * math.pi * self.goal.length / self.settings.task.speed

    def reference_velocity(self, elapsed):
        """A sine: out, back, out, ..."""
        speed = self.settings.task.speed * math.sin(math.pi * elapsed / self._stroke_time())
        direction = math.radians(self.goal.direction_deg)
        return speed * np.array([math.cos(direction), math.sin(direction), 0.0, 0.0, 0.0, 0.0])

    def finished(self, elapsed):
        """After the last stroke."""
        return elapsed >= self.goal.strokes * self._stroke_time()


# the report: the numbers of surface following, and one of our own
FIELDS = {**surface_following.REPORT.fields, "strokes_mm": "way to and fro (mm)"}


def numbers(record, run):
    """All numbers of the arm."""
    common = surface_following.REPORT.numbers(record, run)
    return {**common, "strokes_mm": common["path_length_mm"]}


def summary(values):
    """What a person wants to see first."""
    return [*surface_following.REPORT.summary(values), ("rubbed", f"{values['strokes_mm']:.1f} mm", "")]


REPORT = replace(surface_following.REPORT, fields=FIELDS, numbers=numbers, summary=summary)
