"""Feedforward-feedback PID in the tangent spaces of SE(3), six channels with diagonal gains.

The paper's section "Feedforward-feedback control in local and global tangent spaces": with the observed pose
X and the reference X*, the error is `log(X^-1 X*)` in the local tangent space (that of the body) or
`log(X* X^-1)` in the global one, and

    u = v + Kp e + Ki int(e dt) + Kd de/dt

Integral and derivative are backward Euler; the derivative is that of an exponentially weighted moving average
(EWMA) of the error. Vectors are [rho, phi]: translation (m) first, then rotation (rad).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import Settings, setting
from tactile_base.stamps import NANOSECOND
from tactile_control import _laws
from tactile_geometry import se3

Array = NDArray[np.float64]

CHANNELS = ("rho_x", "rho_y", "rho_z", "phi_x", "phi_y", "phi_z")
SPACES = ("local", "global")
_INTEGRAL, _TRANSFER = 0, 4  # rows of the state that C advances
FEEDBACK, PROPORTIONAL, INTEGRAL, DERIVATIVE, TRANSFER = range(5)  # rows of what a step gives
#: Beyond this (m, rad, m/s, rad/s) is no error and no velocity, but a fault; with any gains all stays finite.
LARGEST_INPUT = 1e3


class ControlInputError(ValueError):
    """A number or a stamp that no controller can use: NaN, too large, of the wrong shape, or not later."""


@dataclass(frozen=True)
class PidSettings(Settings):
    """Diagonal gains and limits of a `TangentPid`. Zero gains and no limits by default."""

    kp: tuple[float, ...] = setting(
        [0.0] * 6, length=6, lower=0.0, upper=100.0, unit="1/s", doc="proportional gains"
    )
    ki: tuple[float, ...] = setting(
        [0.0] * 6, length=6, lower=0.0, upper=1000.0, unit="1/s^2", doc="integral gains"
    )
    kd: tuple[float, ...] = setting(
        [0.0] * 6, length=6, lower=0.0, upper=10.0, unit="1", doc="derivative gains"
    )
    integral_limit: tuple[float, ...] = setting(
        [np.inf] * 6,
        length=6,
        lower=0.0,
        upper=np.inf,
        unit="m s, rad s",
        doc="the integral of each error is clipped to +- this, before its gain; .inf: it is not",
    )
    output_limit: tuple[float, ...] = setting(
        [np.inf] * 6,
        length=6,
        lower=0.0,
        upper=np.inf,
        unit="m/s, rad/s",
        doc="each channel of the feedback is clipped to +- this; its integral does not wind up meanwhile; "
        ".inf: it is not",
    )
    ewma_decay: float = setting(
        0.5,
        lower=0.0,
        upper=0.999,
        doc="weight of the past in the moving average whose derivative is taken (the paper's 0.5)",
    )
    longest_step: float = setting(
        0.1,
        lower=1e-3,
        upper=10.0,
        unit="s",
        doc="after a gap longer than this the integral advances by this only and the derivative is zero",
    )
    transfer_time: float = setting(
        0.5,
        lower=0.0,
        upper=60.0,
        unit="s",
        doc="time constant with which the output goes over to new gains that were set while it runs",
    )


def tangent_error(X: Array, X_reference: Array, space: str = "local") -> Array:
    """Error (6,) from X to X_reference, in the local (`X^-1 X*`) or global (`X* X^-1`) tangent space."""
    if space == "local":
        return se3.log(se3.between(X, X_reference))
    if space == "global":
        return se3.log(se3.compose(X_reference, se3.inverse(X)))
    raise ValueError(f"tangent space '{space}': must be one of {', '.join(SPACES)}")


def to_local(control: Array, X: Array, space: str) -> Array:
    """A control signal (6,) computed in `space`, in the local tangent space at X (what a robot takes)."""
    return control if space == "local" else se3.adjoint(se3.inverse(X)) @ control


class TangentPid:
    """PID over six channels of one tangent space; knows nothing of poses, only of their errors.

    Time comes from the stamps of the errors. The first step after construction or `reset` has neither
    integral nor derivative. New gains through `configure` never make the output jump: the difference between
    the old and the new law at the last error is carried on and fades with `transfer_time`.
    """

    def __init__(self, settings: PidSettings) -> None:
        self.settings = settings
        self._gains = _gains(settings)
        self.reset()

    @property
    def integral(self) -> Array:
        """Of the error (6,)."""
        return self._state[_INTEGRAL]

    def reset(self) -> None:
        """Forget integral, derivative and the last stamp."""
        self.stamp_ns: int | None = None
        self._state = np.zeros((5, 6))

    def configure(self, settings: PidSettings) -> None:
        """Replace the settings between two steps without a jump of the output."""
        before = _laws.pid_law(self._state, self._gains)
        self.settings, self._gains = settings, _gains(settings)
        limit = np.asarray(settings.integral_limit)
        self._state[_INTEGRAL] = self.integral.clip(-limit, limit)
        if self.stamp_ns is not None:
            self._state[_TRANSFER] = 0.0
            self._state[_TRANSFER] = before - _laws.pid_law(self._state, self._gains)

    def update(self, stamp_ns: int, error: ArrayLike, hold_integral: bool = False) -> Array:
        """Advance to `stamp_ns` with the error (6,) measured there.

        Returns the feedback, and the terms that it is the sum of before it is clipped (5, 6): proportional,
        integral, derivative, and what is left of the gains before.

        Parameters
        ----------
        hold_integral : bool
            Do not integrate in this step: for a caller whose own limits keep the feedback from acting.

        Raises
        ------
        ControlInputError
            The error is not six numbers within `LARGEST_INPUT`, or the stamp is not later. The state stays as
            it was.
        """
        error = checked_vector("error", error)
        dt, gap = self._elapsed(stamp_ns)
        self.stamp_ns, s = stamp_ns, self.settings
        return _laws.pid_step(
            self._state, self._gains, error, dt, gap, not hold_integral, s.ewma_decay, s.transfer_time
        )

    def _elapsed(self, stamp_ns: int) -> tuple[float, bool]:
        """Seconds since the last step, at most `longest_step`; True after a gap and at the first step."""
        if self.stamp_ns is None:
            return 0.0, True
        if stamp_ns <= self.stamp_ns:
            raise ControlInputError(f"stamp {stamp_ns} ns is not later than the last one, {self.stamp_ns} ns")
        dt = (stamp_ns - self.stamp_ns) * NANOSECOND
        longest = self.settings.longest_step
        return min(dt, longest), dt > longest


def _gains(settings: PidSettings) -> Array:
    """As C takes them (5, 6)."""
    rows = settings.kp, settings.ki, settings.kd, settings.integral_limit, settings.output_limit
    return np.array(rows, dtype=np.float64)


def checked_vector(name: str, value: ArrayLike) -> Array:
    """The value as a new (6,) float array; `ControlInputError` names the channels beyond `LARGEST_INPUT`."""
    vector = _laws.vector(value, LARGEST_INPUT)
    if vector is not None:
        return vector
    array = np.asarray(value, dtype=np.float64)
    if array.shape != (6,):
        raise ControlInputError(f"{name}: shape {array.shape}, must be (6,)")
    named = zip(CHANNELS, array, strict=True)
    bad = [f"{channel} = {number}" for channel, number in named if not abs(number) <= LARGEST_INPUT]
    raise ControlInputError(f"{name} is no number within {LARGEST_INPUT:g}: {', '.join(bad)}")
