"""What the simulated cell knows about a contact, in the arm's base frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Truth:
    """The contact of one sensor at one stamp; without a surface, `surface` is empty and the rest NaN.

    Attributes
    ----------
    surface : str
        Name of the surface that is meant, the nearest.
    in_contact : bool
        Whether the undeformed tip reaches below the surface.
    depth : float
        Depth of the undeformed tip below the surface, m; negative off it.
    normal_angle : float
        Angle between the sensor's z axis and the surface's inward normal at the nearest point, rad.
    T_fs : ndarray (4, 4)
        Equivalent surface contact pose X_fs.
    shear : ndarray (3,)
        Its shear: x, y (m) and turn gamma (rad) of X_fs as extrinsic xyz Euler angles.
    slip_fraction : float
        How much of the contact slips, 0..1.
    normal_force : float
        Force of the surface on the sensor along the outward normal, N; NaN where it is not modelled.
    point, normal : ndarray (3,)
        Nearest point of the true surface (m) and the outward unit normal there, in the arm's base.
    """

    surface: str
    in_contact: bool
    depth: float
    normal_angle: float
    T_fs: Array
    shear: Array
    slip_fraction: float
    normal_force: float
    point: Array
    normal: Array

    @classmethod
    def nothing(cls) -> Truth:
        """The truth of a sensor that no surface is there for."""
        nan = float("nan")
        missing = np.full(3, nan)
        return cls("", False, nan, nan, np.full((4, 4), nan), missing, 0.0, 0.0, missing, missing)


def shear_of(T_fs: Array) -> Array:
    """Shear (3,) of a contact pose: x, y (m) and gamma (rad), its turn about {f}'s z."""
    return np.array([T_fs[0, 3], T_fs[1, 3], np.arctan2(T_fs[1, 0], T_fs[0, 0])])
