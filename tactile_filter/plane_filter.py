"""The filter of contacts that stay in a plane, many side by side in arrays: a Kalman filter of each channel.

As `ContactFilter` to first order in what an estimate errs, without the gate: the belief is carried along
with the sensor's own motion, and each of four channels takes its part of the difference to the estimate. A
direction of a sensor is a complex number, ahead + i left; turns are as seen from above; down is apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tactile_base.array_math import ArrayMath
from tactile_base.settings import SettingError
from tactile_filter.filter_settings import FilterSettings

Array = Any  # of the library in use


@dataclass
class PlaneBelief:
    """X_sf of N contacts as believed, of one exposure.

    Attributes
    ----------
    present : (N,) whether there is contact
    at, turn, down : the feature in the sensor: ahead + i left, m; turn, rad; down, m
    """

    present: Array
    at: Array
    turn: Array
    down: Array


class PlaneFilter:
    """Beliefs of N contacts.

    Parameters
    ----------
    sigma : (4, N)
        Standard deviations of the estimates: ahead, left and down, m, and turning, rad.
    """

    def __init__(self, settings: FilterSettings, sigma: Array, math: ArrayMath) -> None:
        if settings.robust != "none" or settings.process_noise_interval:
            raise SettingError("fidelity plane: the filter has to have robust none, process_noise_interval 0")
        self._math, self._measured = math, math.array(sigma) ** 2
        way, turn = settings.process_noise_translation**2, settings.process_noise_rotation**2
        noise = self._measured * 0.0 + way
        self._noise = noise + math.array([[0.0], [0.0], [0.0], [turn - way]])
        self._variance = self._measured
        self._last: tuple[PlaneBelief, Any] | None = None

    def observe(self, seen: Any, pose: Any) -> PlaneBelief:
        """Take what an exposure shows (`Seen` of the plane's cell) where the sensors are (its `Pose`)."""
        belief = PlaneBelief(seen.present, seen.at, seen.turn, seen.down)
        if self._last is not None:
            belief = self._corrected(belief, pose, *self._last)
        self._last = belief, pose
        return belief

    def _corrected(self, seen: PlaneBelief, pose: Any, last: PlaneBelief, before: Any) -> PlaneBelief:
        math = self._math
        turned, back = before.turn - pose.turn, math.exp(-1j * pose.turn)
        at = back * (before.at - pose.at) + math.exp(1j * turned) * last.at
        turn, down = last.turn + turned, last.down + pose.height - before.height
        goes_on = seen.present & last.present
        grown = self._variance + self._noise
        gain = math.where(goes_on, grown / (grown + self._measured), 1.0)
        self._variance = math.where(goes_on, (1.0 - gain) * grown, self._measured)
        about = seen.turn - turn
        about = math.arctan2(math.sin(about), math.cos(about))
        off = seen.at - math.exp(1j * about) * at  # of log(X_seen X^-1), to second order
        off = off * (1.0 - about * about / 12.0 - 0.5j * about)
        part = gain[3] * about
        step = (gain[0] * off.real + 1j * gain[1] * off.imag) * math.exp(0.5j * part)
        return PlaneBelief(
            seen.present,
            math.where(goes_on, math.exp(1j * part) * at + step, seen.at),
            math.where(goes_on, turn + part, seen.turn),
            math.where(goes_on, down + gain[2] * (seen.down - down), seen.down),
        )
