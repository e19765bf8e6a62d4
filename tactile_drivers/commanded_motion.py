"""What a driver has told its arm, what that one says and when, and the fault in which it follows nothing."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import ArrayLike

from tactile_base.stamps import SECOND_NS
from tactile_scene.arm import HELD_UP, ArmMode, is_at_rest

_PATIENT = 10.0  # times longer an arm at rest may be silent, or late
_SETTLES = 5.0  # s, until the smallest delay of messages has been seen


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


class CommandedMotion:
    """The motion that an arm was told; its driver holds its lock around each call.

    Parameters
    ----------
    state_timeout : float
        Silence or lateness of states that is a lost connection in motion, s.

    Attributes
    ----------
    twist : ndarray (6,)
        In force, of the controlled frame; zero where the arm was told to rest.
    commanded : float
        When the last one came, s of `time.monotonic`.
    moving : bool
        Whether a command is in force.
    reason : str
        Why the arm rests, if it was told why.
    fault : str
        Why it follows nothing until it recovers; '' for no fault.
    """

    def __init__(self, state_timeout: float) -> None:
        self.twist, self.commanded = np.zeros(6), 0.0
        self.moving, self.reason, self.fault = False, "", ""
        self.fault_mode = ArmMode.FAULT
        self.clock = ClockOffset()
        self._state_timeout, self._stamp_ns = state_timeout, -1

    def follow(self, twist: ArrayLike) -> bool:
        """Take a twist (6,); False in a fault."""
        if self.fault:
            return False
        self.twist, self.commanded = np.array(twist, dtype=np.float64), time.monotonic()
        self.moving, self.reason = True, ""
        return True

    def rest(self, reason: str) -> None:
        """Come to rest; the next command moves the arm again."""
        self.twist, self.moving, self.reason = np.zeros(6), False, reason

    def begin_fault(self, reason: str, by_a_person: bool = False) -> None:
        """Follow nothing any more; an emergency stop where a person has stopped the arm."""
        self.twist, self.moving, self.fault = np.zeros(6), False, reason
        self.fault_mode = ArmMode.ESTOP if by_a_person else ArmMode.FAULT

    def recover(self) -> None:
        """Leave the fault."""
        self.fault, self.moving, self.reason = "", False, "fault cleared"

    def expire(self, limit: float) -> None:
        """The arm stops by itself when commands have been silent for this long (s)."""
        silence = time.monotonic() - self.commanded
        if self.moving and silence > limit:
            self.rest(f"no command for {silence:.3f} s (limit of the driver {limit:g} s)")

    @property
    def patience(self) -> float:
        """How long (s) the arm may say nothing, or be late: at rest nothing depends on it."""
        return self._state_timeout * (1.0 if self.twist.any() else _PATIENT)

    def stamp(self, device_time: float, now_ns: int) -> int:
        """Time (ns) of a state of the controller's time (s) that came at `now_ns`; later than the last."""
        self._stamp_ns = max(self.clock.stamp_ns(device_time, now_ns), self._stamp_ns + 1)
        return self._stamp_ns

    def lateness(self, now_ns: int) -> str:
        """Why the last stamp is too late at `now_ns`; '' if it is not."""
        late = (now_ns - self._stamp_ns) / SECOND_NS
        if late <= self.patience:
            return ""
        return f"states of the arm come {late:.3f} s late (limit {self.patience:g} s): {HELD_UP}"

    def mode(self, twist: ArrayLike) -> ArmMode:
        """What the arm does that moves with this twist (6,)."""
        if self.fault:
            return self.fault_mode
        if self.moving and self.twist.any():
            return ArmMode.MOVING
        if is_at_rest(twist):
            return ArmMode.RESTING
        return ArmMode.MOVING if self.moving else ArmMode.STOPPING

    def words(self, remark: str) -> str:
        """Why the arm does what it does, with what its controller does less; '' for nothing."""
        return self.fault or "; ".join(filter(None, (self.reason, remark)))
