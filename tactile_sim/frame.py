"""What one exposure of a simulated sensor gives, with the truth of the contact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_geometry.gaussian import PoseGaussian

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
    slip_fraction : float
        How much of the contact slips, 0..1.
    normal_force : float
        Force of the surface on the sensor along the outward normal, N; NaN where it is not modelled.
    force : ndarray (3,)
        The whole force of the surface on the sensor, N, in {s}; NaN where it is not modelled.
    nearest, outward : ndarray (3,)
        Nearest point of the true surface (m) and the outward unit normal there, in its body's frame.
    T_base_body : ndarray (4, 4)
        That body in the arm's base.
    """

    surface: str
    in_contact: bool
    depth: float
    normal_angle: float
    T_fs: Array
    slip_fraction: float
    normal_force: float
    force: Array
    nearest: Array
    outward: Array
    T_base_body: Array

    @property
    def point(self) -> Array:
        """The nearest point (3,) in the arm's base, m."""
        return np.asarray(self.T_base_body[:3, :3] @ self.nearest + self.T_base_body[:3, 3])

    @property
    def normal(self) -> Array:
        """The normal (3,) there in the arm's base."""
        return np.asarray(self.T_base_body[:3, :3] @ self.outward)

    @property
    def shear(self) -> Array:
        """Its shear (3,): x, y (m) and turn gamma (rad) of X_fs as extrinsic xyz Euler angles."""
        T_fs = self.T_fs
        return np.array([T_fs[0, 3], T_fs[1, 3], np.arctan2(T_fs[1, 0], T_fs[0, 0])])

    @classmethod
    def nothing(cls) -> Truth:
        """The truth of a sensor that no surface is there for."""
        nan = float("nan")
        missing, missing_pose = np.full(3, nan), np.full((4, 4), nan)
        return cls("", False, nan, nan, missing_pose, 0.0, 0.0, np.zeros(3), missing, missing, missing_pose)


@dataclass(frozen=True)
class Frame:
    """One exposure of one sensor.

    Attributes
    ----------
    sequence : int
        Number of the exposure, from 0.
    image : ndarray (480, 640) uint8, or (size, size) with a view of a network, or None
        None for a sensor that gives estimates.
    estimate : PoseGaussian or None
        X_sf from a sensor of fidelity "fitted" or "ideal" in contact; else None.
    truth : Truth
    T_base_sensor : ndarray (4, 4)
        Where the arm says that the sensor was at the stamp.
    plain_depth : float
        With an estimate: the depth that the brightness of an image would have, m; else NaN.
    """

    arm: str
    stamp_ns: int
    sequence: int
    image: NDArray[np.uint8] | None
    estimate: PoseGaussian | None
    truth: Truth
    T_base_sensor: Array
    plain_depth: float = float("nan")
