"""TrackingMonitor: does the arm do what it was told? What it was told against what its states say.

An arm without overshoot moves, on each axis, no faster than it was told to within its lag, and no slower,
but for the time that its acceleration takes. Over a window, the way that its poses have come has to lie
between the integrals of both. The twists that it reports of itself have to fit the same way.

What is more than was told, or otherwise, is a lie or a danger, and known at once. Less than was told can have
a reason of the arm's own (a singularity, somebody's slider): that is told first, and a fault if it goes on.
"""

from __future__ import annotations

import functools
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_geometry import se3
from tactile_scene.arm import ArmState
from tactile_scene.arm_settings import ArmLimits, TrackingSettings

Array = NDArray[np.float64]

_STEP_NS = 15_000_000  # states nearer to each other than this are looked at together
_LATEST_NS = SECOND_NS // 5  # by which a machine that is held up delays what an arm is told, at most
_PAUSE_NS = SECOND_NS // 2  # without states for so long the window begins anew
_STANDS, _PART = 0.1, 0.5  # of the least way that was told: less is none, and less is too little
_LASTS = 0.1  # s, for which none, or poses that do not fit speeds, are no pause of whoever tells them
_EXTREMES = tuple(functools.partial(ufunc.reduce, axis=0) for ufunc in (np.minimum, np.maximum))
_UNITS = (1e3, "mm"), (180.0 / np.pi, "deg")


class Deviation(NamedTuple):
    """What an arm did otherwise, in words, and whether it moved although it was told to rest."""

    text: str
    by_itself: bool


class _Bounds:
    """Least and largest velocity (6,) in the base that a signal allows now, and their integrals."""

    def __init__(self, lag: float, acceleration: Array | None) -> None:
        self._lag_ns, self._acceleration = round(lag * SECOND_NS), acceleration
        self._said: deque[tuple[int, Array]] = deque([(0, np.zeros(6))])
        self.low, self.high = np.zeros(6), np.zeros(6)
        self.way_low, self.way_high = np.zeros(6), np.zeros(6)

    def say(self, stamp_ns: int, velocity: Array) -> None:
        """It is this from now on."""
        self._said.append((stamp_ns, velocity))

    def advance(self, from_ns: int, to_ns: int, part: float, late_ns: int = 0) -> None:
        """Integrate over an interval; an arm that is slowed down may do only `part` of it.

        `late_ns` is what a signal may take besides its lag.
        """
        said, since = self._said, from_ns - self._lag_ns - late_ns
        while len(said) > 1 and said[1][0] <= since:
            said.popleft()
        held = [velocity for stamp, velocity in said if stamp <= to_ns] or [said[0][1]]
        held = held if part >= 1.0 else [*held, part * held[0], part * held[-1]]
        dt = (to_ns - from_ns) / SECOND_NS
        low, high = (reduce(held) for reduce in _EXTREMES)
        if self._acceleration is not None:
            low = np.minimum(low, self.low + self._acceleration * dt)
            high = np.maximum(high, self.high - self._acceleration * dt)
        self.low, self.high = low, high
        self.way_low, self.way_high = self.way_low + low * dt, self.way_high + high * dt


class _Sample(NamedTuple):
    stamp_ns: int
    T: Array
    told: tuple[Array, Array]
    reported: tuple[Array, Array]
    fastest: tuple[float, float]


class TrackingMonitor:
    """See the module's text; all velocities (6,) are of the controlled frame's origin, along the base's axes.

    Attributes
    ----------
    shortfall : str
        What the arm does less than it was told, as long as that is no fault; '' for nothing.
    moves : bool
        Whether its poses moved in the last window, by more than they may at rest.
    """

    def __init__(self, limits: ArmLimits, settings: TrackingSettings) -> None:
        self.settings, self._limits = settings, limits
        self._tolerance = np.array([settings.speed_tolerance, settings.angular_tolerance])
        self.restart()

    def restart(self) -> None:
        """Begin anew, with an arm at rest that was told nothing."""
        limits = self._limits
        acceleration = np.repeat([limits.linear_acceleration, limits.angular_acceleration], 3)
        self._told = _Bounds(self.settings.lag, acceleration)
        self._reported = _Bounds(self.settings.lag, None)
        self._samples: deque[_Sample] = deque()
        self._short = 0.0  # s, for which less was done than told
        self._unfit_since: int | None = None
        self.shortfall, self.moves = "", False

    def due(self, stamp_ns: int) -> bool:
        """Whether a state of that stamp is to be looked at: some come too often."""
        return not self._samples or not 0 <= stamp_ns - self._samples[-1].stamp_ns < _STEP_NS

    def told(self, stamp_ns: int, velocity: Array) -> None:
        """The arm is told to move at this velocity (6,) from now on."""
        self._told.say(stamp_ns, velocity)

    def see(self, state: ArmState, late_ns: int = 0) -> Deviation | None:
        """Take a state; what it says that the arm did otherwise, over the last window.

        Parameters
        ----------
        late_ns : int
            How late it came: what the arm was told may have been as late.
        """
        self._reported.say(state.stamp_ns, in_base(state.T_base_controlled, state.twist))
        last = self._samples[-1] if self._samples else None
        if last is None or state.stamp_ns - last.stamp_ns > _PAUSE_NS:
            self._samples.clear()
            last_ns = state.stamp_ns
        else:
            last_ns = last.stamp_ns
        self._told.advance(last_ns, state.stamp_ns, state.speed_scaling, min(max(late_ns, 0), _LATEST_NS))
        self._reported.advance(last_ns, state.stamp_ns, 1.0)
        return self._compared(self._sampled(state))

    def _sampled(self, state: ArmState) -> _Sample:
        told, reported = self._told, self._reported
        largest = np.maximum(np.abs(told.low), np.abs(told.high))
        fastest = se3.norm(largest[:3]), se3.norm(largest[3:])
        ways = (told.way_low, told.way_high), (reported.way_low, reported.way_high)
        self._samples.append(_Sample(state.stamp_ns, state.T_base_controlled, *ways, fastest))
        return self._samples[-1]

    def _compared(self, now: _Sample) -> Deviation | None:
        samples, window_ns = self._samples, round(self.settings.window * SECOND_NS)
        while len(samples) > 2 and now.stamp_ns - samples[1].stamp_ns >= window_ns:
            samples.popleft()
        first = samples[0]
        seconds = (now.stamp_ns - first.stamp_ns) / SECOND_NS
        if seconds == 0.0:
            return None
        way = _way(first.T, now.T)
        self.moves = _beyond(way, self._tolerance * self.settings.window)
        fastest = np.array([max(sample.fastest[part] for sample in samples) for part in (0, 1)])
        allowed = self._tolerance * self.settings.window + self.settings.part * fastest * seconds
        low, high = now.told[0] - first.told[0], now.told[1] - first.told[1]
        told = _nearest(way, low, high)
        if _beyond(way - _nearest(way, np.minimum(low, 0.0), np.maximum(high, 0.0)), allowed):
            by_itself = bool((np.abs(low) + np.abs(high) < 1e-9).all())
            return Deviation(_otherwise(seconds, told, way), by_itself)
        low, high = now.reported[0] - first.reported[0], now.reported[1] - first.reported[1]
        reported = _nearest(way, low, high)
        if not _beyond(way - reported, allowed + self.settings.part * _sizes(reported)):
            self._unfit_since = None
        elif self._unfit_since is None:
            self._unfit_since = now.stamp_ns
        elif now.stamp_ns - self._unfit_since >= _LASTS * SECOND_NS:
            said = f"in {seconds * 1e3:.0f} ms its speeds say that it went {_words(reported, way)}"
            return Deviation(f"{said}, its poses {_words(way, reported)}", by_itself=False)
        return self._short_of(now.stamp_ns, seconds, told, way, allowed)

    def _short_of(
        self, stamp_ns: int, seconds: float, told: Array, way: Array, allowed: Array
    ) -> Deviation | None:
        """What is missing of the least way that the arm was told; told first, and a fault if it goes on."""
        step = (stamp_ns - self._samples[-2].stamp_ns) / SECOND_NS
        if not _beyond(told - way, allowed):  # what it misses again and again adds up
            self._short, self.shortfall = max(0.0, self._short - step), ""
            return None
        self._short += step
        short = _sizes(told) > allowed
        done = float(np.min(_along(way, told)[short], initial=1.0))
        self.shortfall = f"the arm does {max(done, 0.0):.0%} of what it is told"
        if self._short >= (_LASTS if done < _STANDS else self.settings.patience) and done < _PART:
            return Deviation(_otherwise(seconds, told, way), by_itself=False)
        return None


def in_base(T_base_controlled: Array, twist: Array) -> Array:
    """A twist (6,) of the controlled frame, in it, along the base's axes."""
    R = T_base_controlled[:3, :3]
    return np.concatenate([R @ twist[:3], R @ twist[3:]])


def _way(A: Array, B: Array) -> Array:
    """From pose A to pose B (6,), m and rad, along the base's axes."""
    turn = np.eye(4)
    turn[:3, :3] = B[:3, :3] @ A[:3, :3].T
    return np.concatenate([B[:3, 3] - A[:3, 3], se3.log(turn)[3:]])


def _nearest(way: Array, low: Array, high: Array) -> Array:
    return np.minimum(np.maximum(way, low), high)


def _sizes(way: Array) -> Array:
    return np.array([se3.norm(way[:3]), se3.norm(way[3:])])


def _along(way: Array, told: Array) -> Array:
    """The parts (2,) of what was told, moving and turning, that were done."""
    parts = [way[:3] @ told[:3], way[3:] @ told[3:]]
    return np.array(parts) / np.maximum(_sizes(told) ** 2, 1e-18)


def _beyond(difference: Array, allowed: Array) -> bool:
    return bool(se3.norm(difference[:3]) > allowed[0] or se3.norm(difference[3:]) > allowed[1])


def _otherwise(seconds: float, told: Array, way: Array) -> str:
    return f"in {seconds * 1e3:.0f} ms it was told to go {_words(told, way)}, and went {_words(way, told)}"


def _words(way: Array, other: Array) -> str:
    """A way in mm and degrees, without the part that is small in both."""
    parts = []
    for index, (scale, unit) in enumerate(_UNITS):
        both = [scale * each[3 * index : 3 * index + 3] for each in (way, other)]
        if max(np.abs(part).max() for part in both) >= 0.1:
            parts.append(f"({', '.join(f'{value + 0.0:.1f}' for value in both[0])}) {unit}")
    return " and ".join(parts) or "nowhere"
