"""Where the tip is in the tool, from touches of a plane at several tilts.

A hemispherical tip of radius r that touches a plane has its centre in a parallel one, r off it, however it is
tilted. With R_i, p_i what the arm says of the sensor at touch i, and d the centre as seen from there,

    n . (p_i + R_i d) = h,    |n| = 1

for one normal n and one height h, which takes in the radius and the depth at which contact is told. Least
squares over d, n and h. Touches of one orientation tell n and h. Those under a tilt tell d across the axis of
the sensor by the sine of it, and along it by one less its cosine. At 30 degrees that is 0.13, so that it
counts there if contact is told at another depth beside the tip's middle: `ALONG_SYSTEMATIC` is added for it.
What the scene says holds d to `PRIOR`, so that what the touches do not tell stays as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from tactile_records.calibrating.result import CalibrationError

Array = NDArray[np.float64]

PRIOR = 0.01  # m
ALONG_SYSTEMATIC = 4e-4  # m
LEAST_NOISE = 2e-5  # m, of a touch
LEAST_TOUCHES = 7
_OBSERVED = 5e-4  # m; an offset across the axis has to be told this well
_ALONG_OBSERVED = 1e-3  # m; an offset along it is taken if it is


@dataclass(frozen=True)
class Tip:
    """What was found; lengths in m.

    Attributes
    ----------
    offset, sigma : ndarray (3,)
        The centre of the tip in the sensor frame that the scene says, and standard deviations.
    along_observed : bool
        Whether the offset along the axis (z) is told; it is 0 where not.
    normal : ndarray (3,)
        Of the plane, in the base, towards the sensor.
    residuals : ndarray (N,)
        Of the touches: how far the centre is from the plane that it should be in.
    uncorrected : ndarray (N,)
        The same with the centre where the scene says, for the plane that suits this best.
    tilts : ndarray (N,)
        Angle between the sensor's axis and the plane's normal, rad.
    """

    offset: Array
    sigma: Array
    along_observed: bool
    normal: Array
    residuals: Array
    uncorrected: Array
    tilts: Array

    @property
    def residual(self) -> float:
        """Root mean square, m."""
        return float(np.sqrt(np.mean(self.residuals**2)))


def estimated(T_base_sensor: Array) -> Tip:
    """The tip from where the arm said that the sensor was at each touch (N, 4, 4).

    Raises
    ------
    CalibrationError
        Where the touches do not tell it, with what would be right.
    """
    count = len(T_base_sensor)
    if count < LEAST_TOUCHES:
        raise CalibrationError(
            f"{count} touches: must be at least {LEAST_TOUCHES}, three of them upright beside each other and "
            "the others from at least three tilts"
        )
    first, covariance = _solved(T_base_sensor, PRIOR)
    across = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    if across > _OBSERVED:
        raise CalibrationError(
            f"the offset across the sensor's axis is told to {across * 1e3:.1f} mm, must be to "
            f"{_OBSERVED * 1e3:g}: touch from at least three tilts of 15 degrees and more, in different "
            "directions, and upright in three places that are not in line"
        )
    along = float(np.sqrt(covariance[2, 2] + ALONG_SYSTEMATIC**2))
    observed = along <= _ALONG_OBSERVED
    found, covariance = (first, covariance) if observed else _solved(T_base_sensor, 1e-9)
    sigma = np.sqrt(np.diag(covariance))
    none, _ = _solved(T_base_sensor, 1e-9, 1e-9)
    normal = _normal(found, T_base_sensor)
    return Tip(
        offset=found[:3],
        sigma=np.array([*sigma[:2], along]),
        along_observed=observed,
        normal=normal,
        residuals=_distances(found, T_base_sensor),
        uncorrected=_distances(none, T_base_sensor),
        tilts=np.arccos(np.clip(-T_base_sensor[:, :3, 2] @ normal, -1.0, 1.0)),
    )


def _solved(T: Array, along: float, across: float = PRIOR) -> tuple[Array, Array]:
    """d, two angles of the normal and h (6,), and the covariance (3, 3) of d; priors of d are given, in m."""
    prior = np.array([across, across, along])
    noise = LEAST_NOISE
    for _ in range(2):  # the second time with the noise that the first has shown

        def rows(v: Array, noise: float = noise) -> Array:
            return np.concatenate([_distances(v, T) / noise, v[:3] / prior])

        solution = least_squares(rows, np.zeros(6), x_scale=[1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-3])
        rest = _distances(solution.x, T)
        noise = max(LEAST_NOISE, float(np.sqrt(rest @ rest / max(len(T) - 6, 1))))
    jacobian = solution.jac
    return solution.x, np.linalg.inv(jacobian.T @ jacobian)[:3, :3]


def _normal(v: Array, T: Array) -> Array:
    """The plane's normal: against the mean of the sensor's axes, turned by two small angles."""
    mean = -T[:, :3, 2].mean(axis=0)
    mean = mean / np.linalg.norm(mean)
    u, _, _ = np.linalg.svd(mean[:, None])
    normal = mean + u[:, 1] * v[3] + u[:, 2] * v[4]
    return np.asarray(normal / np.linalg.norm(normal))


def _distances(v: Array, T: Array) -> Array:
    """Of the tip's centre at each touch from the plane, m."""
    centres = T[:, :3, 3] + T[:, :3, :3] @ v[:3]
    return np.asarray((centres - T[:, :3, 3].mean(axis=0)) @ _normal(v, T) - v[5])
