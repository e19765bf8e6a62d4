"""What the filter believes after a step, and what that rests on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from tactile_geometry import se3

Array = NDArray[np.float64]


class BeliefFlag(IntFlag):
    """What a belief rests on; the values are those of tactile_msgs/ContactState."""

    MEASUREMENT_FUSED = 1
    PREDICTED_ONLY = 2
    GATED = 4
    REINITIALIZED = 8
    NO_CONTACT = 16
    INVALID = 32
    NOT_CONVERGED = 64


_UNMEASURED = int(BeliefFlag.INVALID | BeliefFlag.PREDICTED_ONLY)
_INVALID = int(BeliefFlag.INVALID)  # operators of flags take longer than all of a prediction


@dataclass(frozen=True)
class Belief:
    """The contact's pose in the sensor, X_sf = exp(eps^) mean with eps ~ N(0, cov).

    Attributes
    ----------
    stamp_ns : when it holds
    mean, cov : (4, 4) pose and (6, 6) left covariance in m and rad; NaN where flags has INVALID
    nis : normalized innovation squared of the measurement against the prediction; NaN without both
    nis_dof : its degrees of freedom: 6, or 0 where nis is NaN
    flags : BeliefFlag
    reason : why a measurement was not fused or the belief was restarted; empty in the regular case
    rejected : measurements refused since the last reset
    innovation : (6,) or None, whitened innovation: standard normal and independent from step to step if the
        filter's assumptions hold. Its squared length is nis; None where nis is NaN.
    inflation : factor on the measurement's covariance by which it was fused (setting `robust`)
    """

    stamp_ns: int
    mean: Array
    cov: Array
    nis: float = math.nan
    nis_dof: int = 0
    flags: BeliefFlag = BeliefFlag.MEASUREMENT_FUSED
    reason: str = ""
    rejected: int = 0
    innovation: Array | None = None
    inflation: float = 1.0

    @property
    def valid(self) -> bool:
        """Whether mean and cov may be used."""
        return not int(self.flags) & _INVALID

    @property
    def measured(self) -> bool:
        """Whether it may be used and holds a measurement of its stamp: what moves an arm acts on no other."""
        return not int(self.flags) & _UNMEASURED

    def vectors(self) -> tuple[Array, Array]:
        """xi_sf (6,) and the Euler surface contact pose (6,) of X_fs; NaN where the belief is not valid."""
        if not self.valid:
            return np.full(6, math.nan), np.full(6, math.nan)
        return se3.log(self.mean), se3.euler_from_pose(se3.inverse(self.mean))


def invalid_belief(stamp_ns: int, flags: BeliefFlag, reason: str = "", rejected: int = 0) -> Belief:
    """A belief that holds nothing but why."""
    mean, cov = np.full((4, 4), math.nan), np.full((6, 6), math.nan)
    return Belief(stamp_ns, mean, cov, flags=flags | BeliefFlag.INVALID, reason=reason, rejected=rejected)
