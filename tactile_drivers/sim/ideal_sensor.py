"""A sensor without skin or image: the true contact pose plus Gaussian noise, for fast Monte Carlo runs.

Its contact is one point that sticks to the surface until the shear reaches a limit that grows with depth,
then drags along: enough for shear to build up, saturate and reverse as that of a soft tip does.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_drivers.shapes.surface import ContactGeometry, Surface, contact_pose
from tactile_drivers.sim.settings import IdealSensorSettings
from tactile_filter import se3
from tactile_filter.gaussian import PoseGaussian

Array = NDArray[np.float64]

# Of the depth, by which the skin that touches is pressed in on average: the simulated TacTip, rolled by up to
# 20 degrees over a plane at depths of 2 and 4 mm, shears as if it rolled on the radius less this part of it.
_PRESSED = 0.42


@dataclass(frozen=True)
class IdealTruth:
    """What the ideal sensor knows: depth (m), X_fs (4, 4), whether it touches (0 or 1) and slips (0 or 1).

    Forces are not modelled: NaN.
    """

    depth: float
    T_fs: Array
    contact_nodes: int
    slip_fraction: float
    normal_force: float = float("nan")
    force: Array = field(default_factory=lambda: np.full(3, np.nan))
    torque: Array = field(default_factory=lambda: np.full(3, np.nan))


class IdealSensor:
    """One contact point with a memory of where it sticks; deterministic by seed."""

    def __init__(self, settings: IdealSensorSettings | None = None, seed: int = 0) -> None:
        self.settings = settings or IdealSensorSettings()
        self._sigma = np.array([*self.settings.sigma_position, *self.settings.sigma_rotation])
        self.reset(seed)

    def reset(self, seed: int | None = None) -> None:
        """Forget the contact, and start the noise again (with a new seed if given)."""
        if seed is not None:
            self._seed = seed
        self._random = np.random.default_rng(self._seed)
        self._surface: Surface | None = None
        self._T = np.eye(4)
        self._geometry: ContactGeometry | None = None
        self._truth: IdealTruth | None = None
        self._release()

    def advance(self, surface: Surface, T_surface_sensor: Array) -> None:
        """Move to a pose (4, 4) of {s} in the surface's frame."""
        T = np.array(T_surface_sensor, dtype=np.float64)
        if T.shape != (4, 4) or not np.isfinite(T).all():
            raise ValueError(
                f"the pose of the sensor must be a finite (4, 4) matrix, is {T_surface_sensor!r}"
            )
        geometry = contact_pose(surface, T, self.settings.radius)
        touched = surface is self._surface and self._geometry is not None and self._geometry.depth > 0
        if geometry.depth <= 0:
            self._release()
        elif not touched or self._geometry is None:
            self._release()
            self._anchor = geometry.point
        else:
            self._drag(geometry, self._geometry, T)
        self._surface, self._T, self._geometry, self._truth = surface, T, geometry, None

    @property
    def geometry(self) -> ContactGeometry:
        """Where the undeformed tip meets the surface, after the last `advance`."""
        if self._geometry is None:
            raise RuntimeError("the ideal sensor has no pose before the first advance()")
        return self._geometry

    def truth(self) -> IdealTruth:
        """The contact pose after the last `advance`."""
        if self._truth is None:
            self._truth = self._contact_truth(self.geometry)
        return self._truth

    def _contact_truth(self, geometry: ContactGeometry) -> IdealTruth:
        T_fs = geometry.T_fs.copy()
        cos, sin = np.cos(self._turn), np.sin(self._turn)
        T_fs[:3, :3] = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ T_fs[:3, :3]
        if geometry.depth > 0:
            moved = T_fs[:3, :3] @ self._T[:3, :3].T @ (geometry.point - self._anchor)
            T_fs[:2, 3] = moved[:2]
        return IdealTruth(geometry.depth, T_fs, int(geometry.depth > 0), float(self._slips))

    def estimate(self) -> PoseGaussian | None:
        """A Gaussian over X_sf about a noisy mean, new noise each time; None without contact."""
        if self.geometry.depth <= 0:
            return None
        error = self._sigma * self._random.standard_normal(6)
        return PoseGaussian(se3.exp(error) @ se3.inverse(self.truth().T_fs), np.diag(self._sigma**2))

    def _release(self) -> None:
        self._anchor, self._turn, self._slips = np.zeros(3), 0.0, False

    def _drag(self, geometry: ContactGeometry, before: ContactGeometry, T: Array) -> None:
        """Stick, or pull anchor and turn along so that they stay within the limits of this depth."""
        s = self.settings
        limit = float(np.interp(geometry.depth, s.shear_depths, s.shear_limits))
        turn_limit = float(np.interp(geometry.depth, s.shear_depths, s.turn_limits))
        # the way of the tip's matter over the surface: a tip that rolls moves its centre without it
        matter = before.point - (1.0 - _PRESSED) * before.depth * before.normal
        moved = (T @ se3.inverse(self._T) @ np.append(matter, 1.0))[:3] - matter
        offset = before.point + moved - self._anchor
        offset = offset - (offset @ geometry.normal) * geometry.normal
        length = se3.norm(offset)
        turn = self._turn + _turn_between(self._T, T, -(geometry.normal + before.normal))
        self._slips = length > limit or abs(turn) > turn_limit
        self._turn = float(np.clip(turn, -turn_limit, turn_limit))
        kept = min(1.0, limit / length) if length > 0 else 1.0
        self._anchor = geometry.point - kept * offset


def _turn_between(T0: Array, T1: Array, axis: Array) -> float:
    """Rotation (rad) of the sensor from T0 to T1 about an axis, of any length, in the surface's frame."""
    rotation = np.eye(4)
    rotation[:3, :3] = T1[:3, :3] @ T0[:3, :3].T
    return float(se3.log(rotation)[3:] @ axis / np.linalg.norm(axis))
