"""ClockOffset: from a device's own clock to ours, as far as the times of its messages tell."""

from __future__ import annotations

from tactile_base.stamps import SECOND_NS

_SETTLES = 5.0  # s, until the smallest delay has been seen


class ClockOffset:
    """Tracks how far our clock is ahead of a device's, from messages that come with delays of their own.

    A message never comes before it was sent, so the smallest difference that is seen is the offset and the
    smallest delay. Clocks drift apart: what is remembered grows by `drift`, so that a device whose clock is
    slow by no more than that is followed by the fastest messages as they come, and one whose clock is fast
    is followed at once. The error is the smallest delay, which no receiver can know, and what the drift makes
    between two messages that came about as fast.

    Parameters
    ----------
    drift : float
        Largest drift of the device's clock, s/s.
    """

    def __init__(self, drift: float = 200e-6) -> None:
        self._drift = drift
        self._offset_ns: float | None = None
        self._device = self._started = 0.0
        self._settled: tuple[float, float] | None = None  # device's time, offset

    def stamp_ns(self, device: float, now_ns: int) -> int:
        """Our time (ns) of a message that is stamped `device` (s) and came at `now_ns`.

        A device's clock that goes back has been started anew.
        """
        seen = now_ns - device * SECOND_NS
        if self._offset_ns is None or device < self._device:
            self._offset_ns, self._settled, self._started = seen, None, device
        else:
            grown = self._offset_ns + self._drift * (device - self._device) * SECOND_NS
            self._offset_ns = min(grown, seen)
        self._device = device
        if self._settled is None and device - self._started >= _SETTLES:
            self._settled = device, self._offset_ns
        return round(self._offset_ns + device * SECOND_NS)

    @property
    def drift(self) -> float:
        """By how much our clock has been faster than the device's, s/s; 0 as long as nothing is known."""
        if self._settled is None or self._offset_ns is None or self._device <= self._settled[0]:
            return 0.0
        since, offset_ns = self._settled
        return (self._offset_ns - offset_ns) / ((self._device - since) * SECOND_NS)
