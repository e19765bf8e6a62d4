"""What a fusion of two Gaussians over poses answers, and how it fails."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# A last step below this many posterior standard deviations counts as converged (fixed number of iterations).
CONVERGED_STEP = 1e-3


class FusionError(ValueError):
    """An input that cannot be fused; the message names the matrix and what is wrong with it."""


class FusionStatus(IntEnum):
    """How a fusion ended.

    Attributes
    ----------
    CONVERGED
        The last step was below the tolerance: `CONVERGED_STEP`, or rounding in mode "exact".
    NOT_CONVERGED
        The iterations ended before.
    STALLED
        Mode "exact" only: from no start was a minimum found. The cost is lowest where a mean is a half turn
        away and the logarithm jumps, so that the two inputs contradict each other by many standard
        deviations. The mean is the best one found.
    """

    CONVERGED = 0
    NOT_CONVERGED = 1
    STALLED = 2


class FusionResult(NamedTuple):
    """The fused Gaussian.

    Attributes
    ----------
    mean : (4, 4) pose
    cov : (6, 6) left covariance, equal to ``factor @ factor.T`` and thus symmetric and never indefinite
    factor : (6, 6) lower triangular
    iterations : int
        Steps taken.
    status : FusionStatus
    step : float
        Length of the last step in posterior standard deviations: how far from converged it is.
    """

    mean: Array
    cov: Array
    factor: Array
    iterations: int
    status: FusionStatus
    step: float


class FusionBatch(NamedTuple):
    """Many fused Gaussians, one a row.

    Attributes
    ----------
    mean : (N, 4, 4) poses
    cov, factor : (N, 6, 6)
        As in `FusionResult`.
    status : (N,) int32
        Values of `FusionStatus`.
    step : (N,)
    """

    mean: NDArray[np.floating]
    cov: NDArray[np.floating]
    factor: NDArray[np.floating]
    status: NDArray[np.int32]
    step: NDArray[np.floating]
