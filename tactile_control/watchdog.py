"""Watchdog: ages of the inputs against their limits, and the ramp to rest when one is too old.

From the moment an input goes silent to zero twist it takes its age limit plus `ramp_time`: with the defaults
160 ms, so that the arm rests within 200 ms; a controller that was itself held up meanwhile
commands rest at once. The message says which input, how old it is, and its limit. At rest it waits: an input
that is back within `patience` was a hiccup, one that is not has failed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property

from tactile_base.settings import Settings, setting
from tactile_base.stamps import NANOSECOND


@dataclass(frozen=True)
class WatchdogSettings(Settings):
    """Age limits by input. An age is the time of the step less the input's stamp (an image's exposure)."""

    belief_age: float = setting(0.1, lower=0.005, upper=1.0, unit="s", doc="oldest belief acted upon")
    presence_age: float = setting(
        0.1, lower=0.005, upper=1.0, unit="s", doc="oldest contact presence acted upon"
    )
    force_age: float = setting(
        0.1, lower=0.005, upper=1.0, unit="s", doc="oldest believed force acted upon, where force.* needs it"
    )
    pose_age: float = setting(0.1, lower=0.005, upper=1.0, unit="s", doc="oldest sensor pose acted upon")
    ramp_time: float = setting(
        0.06, lower=0.0, upper=1.0, unit="s", doc="time in which the last twist goes to zero, linearly"
    )
    patience: float = setting(
        1.0,
        lower=0.0,
        upper=60.0,
        unit="s",
        doc="an input that stays too old for this long has failed; until then the arm rests and waits for it",
    )
    future_tolerance: float = setting(
        0.02, lower=0.0, upper=1.0, unit="s", doc="a stamp may lie this far ahead of the clock"
    )
    start_timeout: float = setting(
        10.0, lower=0.1, upper=60.0, unit="s", doc="wait so long, at rest, for inputs that have not come yet"
    )

    @cached_property
    def limits(self) -> dict[str, float]:
        """The age limit (s) of each input, by its name."""
        ages = (item.name for item in fields(self) if item.name.endswith("_age"))
        return {name.removesuffix("_age"): float(getattr(self, name)) for name in ages}


@dataclass(frozen=True)
class WatchdogState:
    """What the watchdog says now.

    scale: 1 while all is well, then down to 0 over the ramp; reason: '' or which input, how old, limit;
    other: another reason to rest, as it was given; failed: at rest, and out of patience.
    """

    scale: float
    reason: str
    other: str = ""
    failed: bool = False

    @property
    def ok(self) -> bool:
        return not self.reason and not self.other


_ALL_WELL = WatchdogState(1.0, "")


class Watchdog:
    """Watches stamps. Recovers when every input is fresh again; whoever asks decides what that means."""

    def __init__(self, settings: WatchdogSettings) -> None:
        self.settings = settings
        self.reset()

    def reset(self) -> None:
        """Forget that anything was ever too old."""
        self._since_ns: int | None = None

    def configure(self, settings: WatchdogSettings) -> None:
        """Replace the limits between two steps."""
        self.settings = settings

    def step(self, now_ns: int, stamps_ns: Mapping[str, int | None], other: str = "") -> WatchdogState:
        """State at `now_ns` for the stamps of the inputs needed now (None: none has come yet).

        `other` is a reason to rest that has nothing to do with them; empty for none.
        """
        reasons = [
            reason for name, stamp in stamps_ns.items() if (reason := self._complaint(now_ns, name, stamp))
        ]
        if not reasons and not other:
            self._since_ns = None
            return _ALL_WELL
        if self._since_ns is None:
            self._since_ns = now_ns
        elapsed = (now_ns - self._since_ns) * NANOSECOND
        ramp, overdue = self.settings.ramp_time, max(elapsed, self._overdue(now_ns, stamps_ns))
        scale = max(0.0, 1.0 - overdue / ramp) if ramp > 0.0 else 0.0
        failed = scale == 0.0 and elapsed >= self.settings.patience
        return WatchdogState(scale, "; ".join(reasons), other, failed)

    def _complaint(self, now_ns: int, name: str, stamp_ns: int | None) -> str:
        limit = self.settings.limits[name]
        if stamp_ns is None:
            return f"no {name} has arrived (limit {limit * 1e3:.0f} ms)"
        age = (now_ns - stamp_ns) * NANOSECOND
        if age > limit:
            return f"{name} is {age * 1e3:.0f} ms old, limit {limit * 1e3:.0f} ms"
        if age < -self.settings.future_tolerance:
            return f"{name} is stamped {-age * 1e3:.0f} ms ahead of the clock"
        return ""

    def _overdue(self, now_ns: int, stamps_ns: Mapping[str, int | None]) -> float:
        """For how long an input has been too old, s; it may have been so before anybody looked."""
        limits, stamps = self.settings.limits, stamps_ns.items()
        late = [(now_ns - at) * NANOSECOND - limits[name] for name, at in stamps if at is not None]
        return max(late, default=0.0)
