"""What can be set of a surface following task: its own settings, and all settings of the chain under it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tactile_base.settings import SettingError, Settings, setting, unknown_name
from tactile_control.limiter import LimiterSettings
from tactile_control.pid import PidSettings
from tactile_control.servoing import ServoingSettings
from tactile_control.watchdog import WatchdogSettings
from tactile_filter.prediction import PredictionSettings

LOST_CONTACT = ("reapproach", "fail")


@dataclass(frozen=True)
class TaskSettings(Settings):
    """Speeds, tolerances and time limits of the phases of `SurfaceFollowing`."""

    speed: float = setting(
        0.010, lower=0.0, upper=0.2, unit="m/s", doc="reference speed along the surface while following"
    )
    ramp_time: float = setting(
        0.5, lower=0.0, upper=10.0, unit="s", doc="time in which the reference speed comes in, smoothly"
    )
    curvature: float = setting(
        0.0,
        lower=-200.0,
        upper=200.0,
        unit="1/m",
        doc="curvature of the sensor centre's path that is fed forward as rotation: > 0 over a bulge, 1 / "
        "(surface radius + tip radius - depth); 0 leaves the turning to feedback, as the paper does. "
        "Wants servoing.free_shear: else the turn about a sheared reference adds depth",
    )
    start_timeout: float = setting(
        2.0, lower=0.1, upper=60.0, unit="s", doc="wait this long for inputs that have not arrived yet"
    )
    travel_speed: float = setting(
        0.05, lower=1e-3, upper=1.0, unit="m/s", doc="speed through the air to the start"
    )
    travel_angular_speed: float = setting(
        0.6, lower=1e-2, upper=6.3, unit="rad/s", doc="rotation speed through the air to the start"
    )
    travel_gain: float = setting(
        4.0, lower=0.1, upper=50.0, unit="1/s", doc="speed per distance left when coming to the start"
    )
    travel_height: float = setting(
        0.02,
        lower=0.0,
        upper=1.0,
        unit="m",
        doc="sideways moves to the start are made this far above it (along its -z)",
    )
    position_tolerance: float = setting(
        0.0002, lower=1e-6, upper=0.05, unit="m", doc="the start is reached within this"
    )
    angle_tolerance: float = setting(
        0.005, lower=1e-5, upper=0.5, unit="rad", doc="the start's orientation is reached within this"
    )
    travel_timeout: float = setting(30.0, lower=0.1, upper=600.0, unit="s", doc="longest way to the start")
    approach_speed: float = setting(
        0.004, lower=1e-4, upper=0.1, unit="m/s", doc="speed along the sensor's z until contact"
    )
    press_distance: float = setting(
        0.0007,
        lower=0.0,
        upper=0.02,
        unit="m",
        doc="the approach goes on for this much after the first touch, where images say little yet",
    )
    approach_distance: float = setting(
        0.05, lower=1e-3, upper=1.0, unit="m", doc="without contact within this the task fails"
    )
    approach_timeout: float = setting(20.0, lower=0.1, upper=600.0, unit="s", doc="longest approach")
    settle_depth_tolerance: float = setting(
        0.00025, lower=1e-6, upper=0.02, unit="m", doc="settled when the error along z stays below this"
    )
    settle_angle_tolerance: float = setting(
        0.03, lower=1e-4, upper=1.0, unit="rad", doc="and the tilt error (phi_x, phi_y) below this"
    )
    settle_time: float = setting(0.3, lower=0.0, upper=60.0, unit="s", doc="for this long")
    settle_timeout: float = setting(10.0, lower=0.1, upper=600.0, unit="s", doc="longest settling")
    follow_timeout: float = setting(
        120.0, lower=0.1, upper=3600.0, unit="s", doc="longest following of one path"
    )
    lost_contact_time: float = setting(
        0.1, lower=0.0, upper=10.0, unit="s", doc="contact counts as lost when it was absent for this long"
    )
    lost_contact: str = setting(
        "reapproach", choices=LOST_CONTACT, doc="on lost contact: approach again where the sensor is, or fail"
    )
    reapproaches: int = setting(3, lower=0, upper=100, doc="fail when contact is lost more often than this")
    retreat_distance: float = setting(
        0.015, lower=0.0, upper=1.0, unit="m", doc="way back along the sensor's -z"
    )
    retreat_speed: float = setting(0.03, lower=1e-3, upper=1.0, unit="m/s", doc="speed of the retreat")
    retreat_timeout: float = setting(10.0, lower=0.1, upper=600.0, unit="s", doc="longest retreat")
    pose_step: float = setting(
        0.0002,
        lower=0.0,
        upper=0.01,
        unit="m",
        doc="sensor positions nearer to each other than this do not add to the path length (poses are noisy)",
    )


@dataclass(frozen=True)
class SurfaceFollowingSettings:
    """All settings of the control chain, by group: task, servoing, pid, limiter, watchdog, prediction."""

    task: TaskSettings = field(default_factory=TaskSettings)
    servoing: ServoingSettings = field(default_factory=ServoingSettings)
    pid: PidSettings = field(default_factory=PidSettings)
    limiter: LimiterSettings = field(default_factory=LimiterSettings)
    watchdog: WatchdogSettings = field(default_factory=WatchdogSettings)
    prediction: PredictionSettings = field(default_factory=PredictionSettings)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], where: str = "") -> SurfaceFollowingSettings:
        """Build from {group: {name: value}}; raises `SettingError` that says what was wrong and `where`."""
        return cls().merged(values, where)

    def merged(self, values: Mapping[str, Any], where: str = "") -> SurfaceFollowingSettings:
        """A copy with the values of {group: {name: value}} in place, the others as they are."""
        groups = {item.name: getattr(self, item.name) for item in dataclasses.fields(self)}
        prefix = f"{where}: " if where else ""
        for group, changes in values.items():
            if group not in groups:
                raise SettingError(prefix + unknown_name(group, list(groups)))
            if not isinstance(changes, Mapping):
                raise SettingError(f"{prefix}{group} must hold names and values, is {changes!r}")
            merged = {**dataclasses.asdict(groups[group]), **changes}
            groups[group] = type(groups[group]).from_mapping(merged, f"{prefix}{group}")
        return type(self)(**groups)

    def replaced(self, **changes: Any) -> SurfaceFollowingSettings:
        """A copy with values changed by `group__name`: `replaced(pid__kp=[...], task__speed=0.02)`."""
        nested: dict[str, dict[str, Any]] = {}
        for name, value in changes.items():
            group, _, key = name.partition("__")
            nested.setdefault(group, {})[key] = value
        return self.merged(nested)
