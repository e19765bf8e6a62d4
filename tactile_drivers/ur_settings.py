"""What a scene says of an arm of Universal Robots, and which accelerations its limits need."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

from tactile_base.settings import Settings, setting
from tactile_scene.arm_settings import ArmLimits

E_SERIES, CB3 = "e-series", "cb3"
_RATES = {E_SERIES: 500.0, CB3: 125.0}
_OF_WATCHDOG = 0.8  # of the watchdog's time, within which a stop has to end
_STOPS_WITHIN = 0.1  # s, from the largest speeds
_ABOVE = 1.2  # times the limits of acceleration, so that the arm does not lag behind commands at their limit


@dataclass(frozen=True)
class UrSettings(Settings):
    """How the arm is reached, and what its controller should say of it."""

    host: str = setting("192.168.0.2", doc="address of the controller")
    generation: str = setting(E_SERIES, choices=tuple(_RATES), doc="of the arm")
    model: str = setting("", doc="as the dashboard server tells it, UR5 for instance; empty: any")
    rate: float = setting(
        0.0, lower=0.0, upper=500.0, unit="Hz",
        doc="of states and commands; 0: of the control loop, 500 for an e-Series, 125 for a CB3",
    )  # fmt: skip
    tcp_offset: tuple[float, ...] = setting(
        (0.0,) * 6, length=6, lower=-10.0, upper=10.0, unit="m, rad",
        doc="of the TCP in the flange, position and rotation vector, as the controller has to have it; "
        "the TCP is the scene's tool frame",
    )  # fmt: skip
    payload: float = setting(
        0.0, lower=0.0, upper=50.0, unit="kg", doc="mass at the flange, as the controller has to have it"
    )
    acceleration: float = setting(
        0.0, lower=0.0, upper=200.0, unit="m/s^2, rad/s^2",
        doc="with which speedL goes after each command, translation and rotation; above the limits, which "
        "the commands keep themselves; 0: by a fifth above the larger of both",
    )  # fmt: skip
    deceleration: float = setting(
        0.0, lower=0.0, upper=200.0, unit="m/s^2, rad/s^2",
        doc="of speedStop, translation and rotation; 0: both end within 0.1 s, and before the watchdog",
    )  # fmt: skip
    watchdog: float = setting(
        10.0, lower=2.0, upper=100.0, unit="Hz", doc="the controller stops when it hears less often"
    )
    state_timeout: float = setting(
        0.1,
        lower=0.02,
        upper=1.0,
        unit="s",
        doc="silence or lateness of states that is a lost connection in motion; at rest ten times that",
    )
    connect_timeout: float = setting(
        10.0, lower=1.0, upper=60.0, unit="s", doc="for connection and start of the program"
    )
    upper_registers: bool = setting(
        False, doc="use RTDE registers from 24 on, where a fieldbus has those from 0 on"
    )

    @property
    def loop_rate(self) -> float:
        """Rate of states and commands, Hz."""
        return self.rate or _RATES[self.generation]


def unfit(settings: UrSettings, limits: ArmLimits) -> str:
    """Why no arm can be driven with these settings, here; '' if one can."""
    if importlib.util.find_spec("rtde_control") is None:
        return "the Python package ur_rtde is missing: pip install ur-rtde"
    most = _RATES[settings.generation]
    if settings.loop_rate > most:
        return f"rate = {settings.rate:g} Hz: a {settings.generation} has at most {most:g} Hz"
    needed = _fastest(limits) * settings.watchdog / _OF_WATCHDOG
    if 0.0 < settings.deceleration < needed:
        return (
            f"deceleration = {settings.deceleration:g} m/s^2 and rad/s^2 does not stop the arm from "
            f"{limits.linear_velocity:g} m/s and {limits.angular_velocity:g} rad/s before the watchdog "
            f"({settings.watchdog:g} Hz) does; it has to be at least {needed:g}"
        )
    least = max(limits.linear_acceleration, limits.angular_acceleration)
    if 0.0 < settings.acceleration < least:
        return (
            f"acceleration = {settings.acceleration:g} m/s^2 and rad/s^2 is below the limits of the "
            f"commands, {limits.linear_acceleration:g} m/s^2 and {limits.angular_acceleration:g} rad/s^2: "
            f"the arm would lag behind them; it has to be at least {least:g}"
        )
    return ""


def _fastest(limits: ArmLimits) -> float:
    """The larger number of both speeds: one acceleration has to serve both.

    ur_rtde's program gives speedl and stopl no `aRot`, for which URScript then takes the number of the linear
    acceleration, in rad/s^2 (URScript manual, module motion: speedl, stopl).
    """
    return max(limits.linear_velocity, limits.angular_velocity)


def with_accelerations(settings: UrSettings, limits: ArmLimits) -> UrSettings:
    """The settings with numbers for 0."""
    largest = max(limits.linear_acceleration, limits.angular_acceleration)
    stops = _fastest(limits) * max(1.0 / _STOPS_WITHIN, settings.watchdog / _OF_WATCHDOG)
    return settings.replaced(
        acceleration=settings.acceleration or _ABOVE * largest, deceleration=settings.deceleration or stops
    )
