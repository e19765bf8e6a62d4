"""TwistLimiter: the last gate before the arm. Norm limits and acceleration limits; never passes a NaN on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import Settings, setting
from tactile_base.stamps import NANOSECOND
from tactile_control.pid import CHANNELS
from tactile_filter import se3

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

    @property
    def limited(self) -> bool:
        return self.reason != ""


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
        target, refused = _finite(np.asarray(wanted, dtype=np.float64))
        dt = self._elapsed(now_ns)
        limits = self.settings
        parts, reasons = [], [refused] if refused else []
        for name, rows, speed, acceleration, unit in (
            ("linear", slice(0, 3), limits.linear_speed, limits.linear_acceleration, "m/s"),
            ("angular", slice(3, 6), limits.angular_speed, limits.angular_acceleration, "rad/s"),
        ):
            part, reason = _limit(name, self.twist[rows], target[rows], speed, acceleration * dt, unit)
            parts.append(part)
            reasons += [reason] if reason else []
        self.twist = np.concatenate(parts)
        return LimitedTwist(self.twist.copy(), "; ".join(reasons))

    def _elapsed(self, now_ns: int) -> float:
        """Seconds since the last step within [0, longest_step]; zero at the first step."""
        last = now_ns if self._stamp_ns is None else self._stamp_ns
        self._stamp_ns = now_ns
        return min(max((now_ns - last) * NANOSECOND, 0.0), self.settings.longest_step)


def _finite(twist: Array) -> tuple[Array, str]:
    """The twist, or zero and the reason where it cannot be used."""
    if twist.shape != (6,):
        return np.zeros(6), f"twist of shape {twist.shape} refused, must be (6,): decelerating to rest"
    if not np.isfinite(twist).all():
        bad = [channel for channel, number in zip(CHANNELS, twist, strict=True) if not np.isfinite(number)]
        return np.zeros(6), f"twist not finite in {', '.join(bad)}: decelerating to rest"
    return twist.clip(-HUGE, HUGE), ""


def _limit(
    name: str, last: Array, wanted: Array, speed: float, largest_change: float, unit: str
) -> tuple[Array, str]:
    reasons = []
    norm = se3.norm(wanted)
    if norm > speed:
        wanted = wanted * (speed / norm)
        reasons.append(f"{name} speed {norm:.3g} over {speed:g} {unit}")
    change = wanted - last
    size = se3.norm(change)
    if size > largest_change * (1.0 + 1e-9):
        wanted = last + change * (largest_change / size)
        reasons.append(f"{name} acceleration")
    return wanted, ", ".join(reasons)
