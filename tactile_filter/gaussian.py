"""A Gaussian over poses: a mean and the covariance of a perturbation on its left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PoseGaussian:
    """X = exp(eps^) mean with eps ~ N(0, cov), eps = [rho, phi] (paper's SE(3) random variable).

    The shapes are checked here, the values where they are used: a network may well answer NaN, and the filter
    has to see that in order to count it.

    Attributes
    ----------
    mean : (4, 4) pose
    cov : (6, 6) covariance of eps, in squared units of length, length times rad, rad^2
    """

    mean: Array
    cov: Array

    def __post_init__(self) -> None:
        for name, shape in (("mean", (4, 4)), ("cov", (6, 6))):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape:
                raise ValueError(f"{name}: must have shape {shape}, has {value.shape}")
            object.__setattr__(self, name, value)


UNUSABLE = PoseGaussian(np.full((4, 4), np.nan), np.full((6, 6), np.nan))
"""Stands for an estimate that could not be read: the filter refuses it and predicts."""
