"""Settings of tasks in contact: speeds, tolerances and time limits, and all parts of their control chain."""

from __future__ import annotations

from dataclasses import dataclass, field

from tactile_base.settings import SettingGroups, Settings, setting
from tactile_control.force_reference import ForceControlSettings
from tactile_control.limiter import LimiterSettings
from tactile_control.motion import TravelSettings
from tactile_control.pid import PidSettings
from tactile_control.servoing import ServoingSettings
from tactile_control.surface_check import SurfaceSettings
from tactile_control.watchdog import WatchdogSettings
from tactile_filter.prediction import PredictionSettings

LOST_CONTACT = ("reapproach", "fail")


@dataclass(frozen=True)
class ContactSettings(Settings):
    """Speeds, tolerances and time limits of the phases that tasks in contact share."""

    approach_speed: float = setting(
        0.004, lower=1e-4, upper=0.02, unit="m/s", doc="speed along the sensor's z until contact"
    )
    press_distance: float = setting(
        0.0007,
        lower=0.0,
        upper=0.005,
        unit="m",
        doc="the approach goes on for this much after the first touch, where images say little yet",
    )
    approach_distance: float = setting(
        0.015, lower=1e-3, upper=0.5, unit="m", doc="without contact within this the task fails"
    )
    dry_touch: bool = setting(
        False,
        doc="before the first approach the tip touches by the presence of contact alone and lifts off: that "
        "has to end there, and to be felt again where it was",
    )
    approach_timeout: float = setting(20.0, lower=0.1, upper=600.0, unit="s", doc="longest approach")
    settle_depth_tolerance: float = setting(
        0.00025, lower=1e-6, upper=0.005, unit="m", doc="settled when the error along z stays below this"
    )
    settle_angle_tolerance: float = setting(
        0.03,
        lower=1e-4,
        upper=0.5,
        unit="rad",
        doc="and the tilt error (phi_x, phi_y) below this; errors that have no gain (pid.kp, pid.ki) are not "
        "waited for",
    )
    settle_time: float = setting(0.3, lower=0.0, upper=60.0, unit="s", doc="for this long")
    settle_timeout: float = setting(10.0, lower=0.1, upper=600.0, unit="s", doc="longest settling")
    leave_first: bool = setting(
        True, doc="a task that begins in contact leaves the surface and approaches; else it settles at once"
    )
    lost_contact_time: float = setting(
        0.1, lower=0.0, upper=10.0, unit="s", doc="contact counts as lost when it was absent for this long"
    )
    lost_contact: str = setting(
        "reapproach", choices=LOST_CONTACT, doc="on lost contact: approach again where the sensor is, or fail"
    )
    reapproaches: int = setting(3, lower=0, upper=100, doc="fail when contact is lost more often than this")
    retreat_distance: float = setting(
        0.015, lower=0.0, upper=0.3, unit="m", doc="way back along the sensor's -z"
    )
    retreat_speed: float = setting(0.03, lower=1e-3, upper=0.5, unit="m/s", doc="speed of the retreat")
    retreat_timeout: float = setting(10.0, lower=0.1, upper=600.0, unit="s", doc="longest retreat")
    pose_step: float = setting(
        0.0002,
        lower=0.0,
        upper=0.01,
        unit="m",
        doc="sensor positions nearer to each other than this do not add to the path length (poses are noisy)",
    )


@dataclass(frozen=True)
class ContactTaskSettings(SettingGroups):
    """All settings of the control chain; a task adds its own as the group `task`."""

    travel: TravelSettings = field(default_factory=TravelSettings)
    contact: ContactSettings = field(default_factory=ContactSettings)
    servoing: ServoingSettings = field(default_factory=ServoingSettings)
    pid: PidSettings = field(default_factory=PidSettings)
    limiter: LimiterSettings = field(default_factory=LimiterSettings)
    watchdog: WatchdogSettings = field(default_factory=WatchdogSettings)
    prediction: PredictionSettings = field(default_factory=PredictionSettings)
    surface: SurfaceSettings = field(default_factory=SurfaceSettings)
    force: ForceControlSettings = field(default_factory=ForceControlSettings)
