"""A sensor without skin or image: the true contact pose plus Gaussian noise, for fast Monte Carlo runs.

Its contact is one point that sticks to the surface until the shear reaches a limit that grows with depth,
then drags along: enough for shear to build up, saturate and reverse as that of a soft tip does.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian
from tactile_scene.shapes.surface import ContactGeometry, Surface, contact_pose
from tactile_scene.simulated_sensors import IdealSensorSettings
from tactile_sim import _contact

Array = NDArray[np.float64]

_UNKNOWN = np.full(3, np.nan)  # a force that is not modelled
_UNKNOWN.setflags(write=False)


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
    force: Array = field(default_factory=lambda: _UNKNOWN)
    torque: Array = field(default_factory=lambda: _UNKNOWN)


class IdealSensor:
    """One contact point with a memory of where it sticks; deterministic by seed."""

    def __init__(self, settings: IdealSensorSettings | None = None, seed: int = 0) -> None:
        self.settings = settings or IdealSensorSettings()
        s = self.settings
        self._sigma = np.array([*s.sigma_position, *s.sigma_rotation])
        self._cov = np.diag(self._sigma**2)
        self._limits = np.array([s.shear_depths, s.shear_limits, s.turn_limits])
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
        T = se3.checked_pose("pose of the sensor", T_surface_sensor).copy()
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
        touches = geometry.depth > 0
        T_fs = _contact.point_contact_pose(
            geometry.T_fs, self._turn, *_parts(self._T, geometry), self._anchor if touches else None
        )
        return IdealTruth(geometry.depth, T_fs, int(touches), float(self._slips))

    def estimate(self) -> PoseGaussian | None:
        """A Gaussian over X_sf about a noisy mean, new noise each time; None without contact."""
        if self.geometry.depth <= 0:
            return None
        error = self._sigma * self._random.standard_normal(6)
        return PoseGaussian(se3.compose(se3.exp(error), se3.inverse(self.truth().T_fs)), self._cov.copy())

    def plain_depth(self) -> float:
        """What an image's brightness would say of the depth, m (`PlainDepth`): here the truth."""
        return self.geometry.depth

    def _release(self) -> None:
        self._anchor, self._turn, self._slips = np.zeros(3), 0.0, False

    def _drag(self, geometry: ContactGeometry, before: ContactGeometry, T: Array) -> None:
        """Stick, or pull anchor and turn along so that they stay within the limits of this depth."""
        self._anchor, self._turn, self._slips = _contact.point_contact_drag(
            self._anchor, self._turn, *_parts(self._T, before), *_parts(T, geometry), self._limits
        )


def _parts(T: Array, geometry: ContactGeometry) -> tuple[Array, Array, Array, float]:
    """A contact as C takes it."""
    return T, geometry.point, geometry.normal, geometry.depth
