"""The contact at the time of the command instead of the exposure: what the latency between them costs.

Since the exposure the sensor has moved, which is known: X_sf(t) = T_bs(t)^-1 T_bf(t) with the feature's pose
T_bf = T_bs X_sf at the exposure, if the surface stands still under the sensor. A sensor that follows a curved
surface, or an object that moves, takes the feature along. Its twist, constant in the feature's own frame on
any screw motion, is estimated from the beliefs with a fading memory, and T_bf(t) = T_bf exp(t twist^).

This is for control: what the filter believes remains a belief at the stamp of the exposure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import Settings, setting
from tactile_base.stamps import SECOND_NS
from tactile_geometry import se3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PredictionSettings(Settings):
    """Whether and how the contact is carried on to the time of the command."""

    enabled: bool = setting(False, doc="act on the contact as predicted for now, not as of the exposure")
    motion_time: float = setting(
        0.3, lower=0.0, upper=10.0, unit="s",
        doc="time constant with which the feature's own motion is estimated; 0: the surface stands still",
    )  # fmt: skip
    longest: float = setting(
        0.15, lower=0.0, upper=1.0, unit="s", doc="a belief is not carried on for longer than this"
    )


class ContactPredictor:
    """Carries the last belief on along the known motion of the sensor and the estimated one of the feature.

    Attributes
    ----------
    twist : (6,) of the feature relative to the base, in the feature's frame, m/s and rad/s
    """

    def __init__(self, settings: PredictionSettings | None = None) -> None:
        self.settings = PredictionSettings() if settings is None else settings
        self.reset()

    def configure(self, settings: PredictionSettings) -> None:
        """Take other settings; what is known of the motion stays."""
        self.settings = settings

    def reset(self) -> None:
        """Forget belief and motion."""
        self._stamp_ns: int | None = None
        self._T_base_feature: Array = np.eye(4)
        self.twist: Array = np.zeros(6)

    def update(self, stamp_ns: int, X_sf: Array, T_base_sensor: Array) -> None:
        """Take a belief's mean (4, 4) at its stamp, and the sensor's pose (4, 4) then.

        One that is not later than the last is passed over; after a gap of more than the time constant the
        motion is estimated anew.
        """
        T_base_feature = se3.orthonormalized(T_base_sensor @ X_sf)
        if self._stamp_ns is not None:
            if stamp_ns <= self._stamp_ns:
                return
            elapsed = (stamp_ns - self._stamp_ns) / SECOND_NS
            self._estimate(T_base_feature, elapsed)
        self._stamp_ns, self._T_base_feature = stamp_ns, T_base_feature

    def _estimate(self, T_base_feature: Array, elapsed: float) -> None:
        memory = self.settings.motion_time
        if memory == 0.0 or elapsed > memory:
            self.twist = np.zeros(6)
            return
        seen = se3.log(se3.inverse(self._T_base_feature) @ T_base_feature) / elapsed
        self.twist = self.twist - math.expm1(-elapsed / memory) * (seen - self.twist)

    def ahead(self, stamp_ns: int, T_base_sensor: Array) -> Array | None:
        """X_sf (4, 4) at a stamp, the sensor's pose (4, 4) being known or foreseen for it.

        None without a belief, or if the last one is later than that, or older by more than `longest`.
        """
        if self._stamp_ns is None or not 0 <= stamp_ns - self._stamp_ns <= self.settings.longest * SECOND_NS:
            return None
        elapsed = (stamp_ns - self._stamp_ns) / SECOND_NS
        moved = self._T_base_feature @ se3.exp(elapsed * self.twist)
        return se3.orthonormalized(se3.inverse(T_base_sensor) @ moved)
