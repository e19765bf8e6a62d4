"""Where an undeformed spherical tip meets a surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_drivers.shapes.surface import Array, Surface


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
    the one for which X_fs, as extrinsic xyz Euler angles, has gamma = 0.
    """
    rotation, center = T_surface_sensor[:3, :3], T_surface_sensor[:3, 3]
    distance, normals = surface.query(center[None])
    normal, depth = normals[0], radius - float(distance[0])
    inward = rotation.T @ -normal  # {f}'s z axis in {s}
    T_fs = np.eye(4)
    T_fs[:3, :3] = _rotation_without_turn(inward)
    T_fs[2, 3] = depth
    angle = float(np.arctan2(np.hypot(inward[0], inward[1]), inward[2]))
    return ContactGeometry(depth, T_fs, angle, center - float(distance[0]) * normal, normal)


def _rotation_without_turn(axis: Array) -> Array:
    """R_fs = Ry(beta) Rx(alpha) whose third row, {f}'s z axis in {s}, is the unit vector `axis`."""
    x, y, z = axis
    cos_beta = np.hypot(y, z)
    sin_alpha, cos_alpha = (y / cos_beta, z / cos_beta) if cos_beta > 0 else (0.0, 1.0)
    return np.array([
        [cos_beta, -x * sin_alpha, -x * cos_alpha],
        [0.0, cos_alpha, -sin_alpha],
        [x, cos_beta * sin_alpha, cos_beta * cos_alpha],
    ])  # fmt: skip
