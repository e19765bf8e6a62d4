"""A Gaussian over poses: a mean and the covariance of a perturbation on its left; and that of a ROS pose.

A left perturbation X = exp(eps^) mean, eps = [rho, phi], moves the position p of the mean by rho + phi x p
and turns it by phi about the axes of the reference frame, to first order. ROS means exactly these two errors:
of the position, and of the rotation about fixed axes, both in the header's frame. So

    Sigma_ros = A Sigma A^T,    A = [[I, -[p]x], [0, I]],

and the inverse of A has the other sign of p.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

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


def ros_from_left(cov: ArrayLike, position: ArrayLike) -> Array:
    """Covariance (..., 6, 6) of position and fixed-axis rotation, from the left at a position (..., 3)."""
    return _transformed(cov, -np.asarray(position, dtype=np.float64))


def left_from_ros(cov: ArrayLike, position: ArrayLike) -> Array:
    """Left covariance (..., 6, 6) from that of position and fixed-axis rotation at a position (..., 3)."""
    return _transformed(cov, np.asarray(position, dtype=np.float64))


def _transformed(cov: ArrayLike, position: Array) -> Array:
    sigma = np.asarray(cov, dtype=np.float64)
    if sigma.shape[-2:] != (6, 6) or position.shape != (*sigma.shape[:-2], 3):
        raise ValueError(
            f"cov must have shape (..., 6, 6) and position (..., 3), have {sigma.shape} and {position.shape}"
        )
    # stacks also of one, so that each is multiplied by the same routine
    stack, (x, y, z) = sigma.reshape(-1, 6, 6), position.reshape(-1, 3).T
    A = np.tile(np.eye(6), (len(stack), 1, 1))
    A[:, 0, 4], A[:, 0, 5] = -z, y
    A[:, 1, 3], A[:, 1, 5] = z, -x
    A[:, 2, 3], A[:, 2, 4] = -y, x
    result = A @ stack @ A.transpose(0, 2, 1)
    return (0.5 * (result + result.transpose(0, 2, 1))).reshape(sigma.shape)
