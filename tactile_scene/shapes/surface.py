"""What every shape answers in its own frame: signed distance, outward normal, mesh, where a tip meets it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import Settings
from tactile_scene import _native

Array = NDArray[np.float64]


class Surface(ABC):
    """A rigid surface in its own frame.

    Subclasses name their `Settings` class and implement `query` and `grid`.

    Parameters
    ----------
    settings : Settings, optional
        Of the subclass's `settings_class`; its defaults if left out.
    """

    settings_class: ClassVar[type[Settings]]

    def __init__(self, settings: Any = None) -> None:
        self.settings = settings or self.settings_class()

    @abstractmethod
    def query(self, points: Array) -> tuple[Array, Array]:
        """Signed distance (N,) in m and outward unit normal (N, 3) at `points` (N, 3) in m."""

    @abstractmethod
    def grid(self, n: int = 60) -> Array:
        """Points (rows, columns, 3) in m on the part of the surface that is worth drawing.

        About `n` each way. The direction along a row cross that to the next row points outward.
        """

    def distance(self, points: Array) -> Array:
        """Signed distance (N,) of `points` (N, 3) in m, positive outside."""
        return self.query(points)[0]

    def normal(self, points: Array) -> Array:
        """Outward unit normal (N, 3) at `points` (N, 3): the gradient of the distance."""
        return self.query(points)[1]

    def closest(self, points: Array) -> Array:
        """Points (N, 3) of the surface that are nearest to `points` (N, 3), in m."""
        distance, normal = self.query(points)
        return points - distance[:, None] * normal

    def mesh(self, n: int = 60) -> tuple[Array, NDArray[np.int64]]:
        """Vertices (V, 3) in m and triangles (F, 3), counter-clockwise from outside, of `grid(n)`."""
        points = self.grid(n)
        rows, columns = points.shape[:2]
        index = np.arange(rows * columns).reshape(rows, columns)
        a, b, c, d = (
            block.ravel() for block in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
        )
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        return points.reshape(-1, 3), faces


def rounded_grid(azimuth: Array, corners: Array, height: float, rounding: float, count: int) -> Array:
    """A grid on a sphere, cut and moved to a core's `corners` (N, 2) up and down, and the ends' middles.

    The ends are at -height and height; a corner has a row of `azimuth` (N, M) in rad, and `count` rows.
    """
    polar = np.concatenate([np.linspace(np.pi, np.pi / 2, count), np.linspace(np.pi / 2, 0.0, count)])
    a, p = np.meshgrid(azimuth, polar)
    sides = rounding * np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
    sides[..., :2] += np.repeat(corners, azimuth.shape[1], axis=0)
    sides[..., 2] += np.repeat([rounding - height, height - rounding], count)[:, None]
    sides = np.concatenate([sides, sides[:, :1]], axis=1)
    middle = np.zeros((1, sides.shape[1], 3))
    middle[..., 2] = height
    return np.concatenate([-middle, sides, middle])


@dataclass(frozen=True)
class ContactGeometry:
    """Where an undeformed spherical tip meets a surface.

    Attributes
    ----------
    depth : float
        Depth of the tip below the surface, m; negative off it.
    T_fs : ndarray (4, 4)
        Contact pose X_fs without shear: translation (0, 0, depth), rotation without turn about {f}'s z.
    normal_angle : float
        Angle between the sensor's z axis and the inward normal, rad.
    point, normal : ndarray (3,)
        Nearest point of the surface (m) and outward unit normal there, in the surface's frame.
    """

    depth: float
    T_fs: Array
    normal_angle: float
    point: Array
    normal: Array


def contact_pose(surface: Surface, T_surface_sensor: Array, radius: float) -> ContactGeometry:
    """Geometry of the contact of a tip of the given radius (m) about the sensor frame's origin.

    The feature frame {f} has its z axis along the inward normal at the nearest point of the surface and its
    origin where the sensor's centre would be at first touch, `radius` off the surface. Its turn about z is
    the one for which X_fs, as extrinsic xyz Euler angles, has gamma = 0: R_fs = Ry(beta) Rx(alpha).
    """
    distance, normals = surface.query(T_surface_sensor[None, :3, 3])
    return ContactGeometry(*_native.meet(distance[0], normals[0], T_surface_sensor, radius))
