"""Left covariance <-> the covariance of a ROS pose.

A left perturbation X = exp(eps^) mean, eps = [rho, phi], moves the position p of the mean by rho + phi x p
and turns it by phi about the axes of the reference frame, to first order. ROS means exactly these two errors:
of the position, and of the rotation about fixed axes, both in the header's frame. So

    Sigma_ros = A Sigma A^T,    A = [[I, -[p]x], [0, I]],

and the inverse of A has the other sign of p.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def ros_from_left(cov: ArrayLike, position: ArrayLike) -> Array:
    """Covariance (6, 6) of position and fixed-axis rotation, from the left one at a position (3,)."""
    return _transformed(cov, position, -1.0)


def left_from_ros(cov: ArrayLike, position: ArrayLike) -> Array:
    """Left covariance (6, 6) from that of position and fixed-axis rotation and the mean's position (3,)."""
    return _transformed(cov, position, 1.0)


def _transformed(cov: ArrayLike, position: ArrayLike, sign: float) -> Array:
    sigma = np.asarray(cov, dtype=np.float64)
    p = np.asarray(position, dtype=np.float64)
    if sigma.shape != (6, 6) or p.shape != (3,):
        raise ValueError(f"cov must have shape (6, 6) and position (3,), have {sigma.shape} and {p.shape}")
    x, y, z = (sign * p).tolist()
    A = np.eye(6)
    A[:3, 3:] = (0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)
    result = A @ sigma @ A.T
    return 0.5 * (result + result.T)
