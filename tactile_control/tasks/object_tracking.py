"""Object tracking, the paper's Task 1: keep a contact pose on a surface that moves."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import Settings, setting
from tactile_control.contact_phases import INTO_CONTACT
from tactile_control.contact_settings import ContactTaskSettings
from tactile_control.contact_task import ContactTask
from tactile_control.motion import smooth_ramp
from tactile_control.phases import DONE, FAILED, RETREAT, STOPPING, Goal
from tactile_control.surface_check import SurfaceSettings
from tactile_geometry import se3

Array = NDArray[np.float64]

TRACK = "track"


@dataclass(frozen=True)
class TrackingSettings(Settings):
    """How an object is tracked."""

    feedforward: float = setting(
        0.0,
        lower=0.0,
        upper=1.0,
        doc="part of the surface's own velocity, as the beliefs show it, that is fed forward; 0 as the paper "
        "does. prediction.motion_time is the time constant of its estimate",
    )
    ramp_time: float = setting(
        0.5, lower=0.0, upper=10.0, unit="s", doc="time in which the feedforward comes in, smoothly"
    )


@dataclass(frozen=True)
class ObjectTrackingSettings(ContactTaskSettings):
    """All settings of object tracking. The surface moves, and an object that is held gives way."""

    surface: SurfaceSettings = field(
        default_factory=lambda: SurfaceSettings(speed=0.05, turn_rate=0.5, yields=0.005)
    )
    task: TrackingSettings = field(default_factory=TrackingSettings)


@dataclass(frozen=True)
class TrackingGoal(Goal):
    """How long to track."""

    duration: float = setting(
        0.0, lower=0.0, upper=86400.0, unit="s", doc="track for so long; 0: until the task is asked to end"
    )

    @property
    def ends(self) -> bool:
        """With a duration."""
        return self.duration > 0.0


class ObjectTracking(ContactTask):
    """Follows a surface wherever it moves."""

    settings_class = ObjectTrackingSettings
    goal_class = TrackingGoal
    work = TRACK
    phases = (*INTO_CONTACT, TRACK, STOPPING, RETREAT, DONE, FAILED)
    endless = True

    settings: ObjectTrackingSettings
    goal: TrackingGoal

    def reference_velocity(self, elapsed: float) -> Array:
        """Velocity (6,) of the surface in {s'}, as far as it is to be fed forward.

        With the feature's twist V_f in its own frame, a reference frame {s'} that is fixed to the feature
        has the twist Ad(X_s'f) V_f.
        """
        gain = self.settings.task.feedforward * smooth_ramp(elapsed, self.settings.task.ramp_time)
        if gain == 0.0:
            return np.zeros(6)
        X_fs_reference = se3.pose_from_euler(self.settings.servoing.reference)
        return gain * (se3.adjoint(se3.inverse(X_fs_reference)) @ self.predictor.twist)

    def finished(self, elapsed: float) -> bool:
        """After the goal's duration, if it has one."""
        return 0.0 < self.goal.duration <= elapsed

    def fraction(self) -> float:
        """By the time so far; nothing is known of it without a duration."""
        return min(1.0, self.elapsed / self.goal.duration) if self.goal.duration else 0.0

    def follows_motion(self) -> bool:
        """For the feedforward as well."""
        return self.settings.task.feedforward > 0.0 or super().follows_motion()
