"""TwistLimiter: the last gate before the arm. Norm limits and acceleration limits; never passes a NaN on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import Settings, setting
from tactile_base.stamps import NANOSECOND
from tactile_control import _laws
from tactile_control.pid import CHANNELS
from tactile_geometry import se3

Array = NDArray[np.float64]

HUGE = 1e9  # m/s, rad/s: far over any limit, and its square is still a number


@dataclass(frozen=True)
class LimiterSettings(Settings):
    """Largest speeds and accelerations of the sensor frame's origin and of its rotation."""

    linear_speed: float = setting(0.1, lower=0.0, upper=2.0, unit="m/s", doc="largest norm of v")
    angular_speed: float = setting(1.0, lower=0.0, upper=6.3, unit="rad/s", doc="largest norm of omega")
    linear_acceleration: float = setting(
        0.5, lower=1e-3, upper=50.0, unit="m/s^2", doc="largest norm of dv/dt"
    )
    angular_acceleration: float = setting(
        5.0, lower=1e-2, upper=500.0, unit="rad/s^2", doc="largest norm of domega/dt"
    )
    longest_step: float = setting(
        0.05, lower=1e-3, upper=1.0, unit="s", doc="a longer pause between two steps counts as this long"
    )


@dataclass(frozen=True)
class LimitedTwist:
    """A twist (6,) within the limits, and in words what was done to it ('' where nothing was)."""

    twist: Array
    reason: str


class TwistLimiter:
    """Scales v and omega each to its largest norm and bounds the change of each by acceleration times time.

    Directions are kept where only the norm is limited. It starts from rest. A twist that is not finite is
    replaced by zero: the output decelerates to rest within the acceleration limits and says why.
    """

    def __init__(self, settings: LimiterSettings) -> None:
        self.settings = settings
        self.reset()

    def reset(self, twist: ArrayLike = (0.0,) * 6) -> None:
        """Start again from a known twist, by default from rest."""
        self.twist = np.array(twist, dtype=np.float64)
        self._stamp_ns: int | None = None

    def configure(self, settings: LimiterSettings) -> None:
        """Replace the limits between two steps; the output goes on from where it is."""
        self.settings = settings

    def step(self, now_ns: int, wanted: ArrayLike) -> LimitedTwist:
        """The twist to send at `now_ns`; the last one again where no time has passed since."""
        target, refused = _finite(wanted)
        dt, limits = self._elapsed(now_ns), self.settings
        linear = limits.linear_speed, limits.linear_acceleration * dt
        angular = limits.angular_speed, limits.angular_acceleration * dt
        self.twist, done = _laws.limit_twist(self.twist, target, *linear, *angular)
        return LimitedTwist(self.twist.copy(), self._reason(target, done, refused) if done or refused else "")

    def _reason(self, wanted: Array, done: int, refused: str) -> str:
        """What was done to a twist, by the bits of `limit_twist`."""
        limits, reasons = self.settings, [refused] if refused else []
        for name, part, speed, unit in (
            ("linear", wanted[:3], limits.linear_speed, "m/s"),
            ("angular", wanted[3:], limits.angular_speed, "rad/s"),
        ):
            parts = [f"{name} speed {se3.norm(part):.3g} over {speed:g} {unit}"] if done & 1 else []
            parts += [f"{name} acceleration"] if done & 2 else []
            reasons += [", ".join(parts)] if parts else []
            done >>= 2
        return "; ".join(reasons)

    def _elapsed(self, now_ns: int) -> float:
        """Seconds since the last step within [0, longest_step]; zero at the first step."""
        last = now_ns if self._stamp_ns is None else self._stamp_ns
        self._stamp_ns = now_ns
        return min(max((now_ns - last) * NANOSECOND, 0.0), self.settings.longest_step)


def _finite(wanted: ArrayLike) -> tuple[Array, str]:
    """The twist, or zero and the reason where it cannot be used."""
    twist = _laws.vector(wanted, HUGE)
    if twist is not None:
        return twist, ""
    given = np.asarray(wanted, dtype=np.float64)
    if given.shape != (6,):
        return np.zeros(6), f"twist of shape {given.shape} refused, must be (6,): decelerating to rest"
    if not np.isfinite(given).all():
        bad = [channel for channel, number in zip(CHANNELS, given, strict=True) if not np.isfinite(number)]
        return np.zeros(6), f"twist not finite in {', '.join(bad)}: decelerating to rest"
    return given.clip(-HUGE, HUGE), ""
