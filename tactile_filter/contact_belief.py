"""Beliefs as they are told: none without contact, and as vectors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_filter import se3
from tactile_filter.belief import Belief, BeliefFlag
from tactile_filter.gaussian import PoseGaussian

Array = NDArray[np.float64]

UNUSABLE = PoseGaussian(np.full((4, 4), np.nan), np.full((6, 6), np.nan))
"""Stands for an estimate that is none: the filter refuses it and predicts."""

_NOT_A_NUMBER = np.full(6, np.nan)


def nothing(stamp_ns: int, rejected: int) -> Belief:
    """The belief without contact: none."""
    flags = BeliefFlag.NO_CONTACT | BeliefFlag.INVALID
    return Belief(stamp_ns, UNUSABLE.mean, UNUSABLE.cov, flags=flags, rejected=rejected)


def belief_vectors(belief: Belief) -> tuple[Array, Array]:
    """xi_sf (6,) and the Euler surface contact pose (6,) of X_fs; NaN where the belief holds nothing."""
    if not belief.valid:
        return _NOT_A_NUMBER, _NOT_A_NUMBER
    return se3.log(belief.mean), se3.euler_from_pose(se3.inverse(belief.mean))
