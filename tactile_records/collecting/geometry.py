"""Poses of data collection: the contact frame over a flat surface, and where a sample's motion goes.

The frame {f} has its z into the surface, and its origin where the sensor's centre is at first touch: a tip's
radius off the surface. `X_fs` is the sensor in {f}; its z is the depth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_geometry import se3

Array = NDArray[np.float64]


def contact_frame(T_base_surface: Array, T_base_sensor: Array, radius: float) -> Array:
    """T_base_f (4, 4): the frame {f} under a sensor, on the plane z = 0 of {surface} that faces along its z.

    Its origin is straight below (or above) the sensor's centre; its x-axis is the sensor's, turned into the
    plane.

    Raises
    ------
    ValueError
        If the sensor's z-axis does not point towards the surface, or its x-axis stands on it.
    """
    normal = T_base_surface[:3, 2]
    z = -normal
    if float(T_base_sensor[:3, 2] @ z) <= 0.0:
        raise ValueError("the sensor points away from the surface: its z-axis must point towards it")
    x = T_base_sensor[:3, 0] - z * float(T_base_sensor[:3, 0] @ z)
    length = float(np.linalg.norm(x))
    if length < 1e-6:
        raise ValueError(
            "the sensor's x-axis stands on the surface: no direction for that of the contact frame"
        )
    x = x / length
    height = float((T_base_sensor[:3, 3] - T_base_surface[:3, 3]) @ normal)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = T_base_sensor[:3, 3] + z * (height - radius)
    return T


def above(euler: Array, gap: float) -> Array:
    """X_fs (4, 4) in the air over the first touch, turned to the contact angles of a pose (6,), m and rad."""
    return se3.pose_from_euler([0.0, 0.0, -gap, euler[3], euler[4], 0.0])


def pressed(euler: Array) -> Array:
    """X_fs (4, 4) of the normal contact of a pose: at its depth, before any shear."""
    return se3.pose_from_euler([0.0, 0.0, euler[2], euler[3], euler[4], 0.0])


def lifted(X_fs: Array, gap: float) -> Array:
    """X_fs (4, 4) straight off the surface from where it is; never nearer to it."""
    out = X_fs.copy()
    out[2, 3] = min(-gap, float(X_fs[2, 3]))
    return out


def at(x: float, y: float, z: float) -> Array:
    """X_fs (4, 4) at a position in {f}, untilted."""
    return se3.pose_from_euler([x, y, z, 0.0, 0.0, 0.0])


def places(points: int, radius: float) -> list[tuple[float, float]]:
    """Where to touch, x and y in {f}: the origin for one touch, else evenly on a circle."""
    if points <= 1:
        return [(0.0, 0.0)] * points
    angles = 2.0 * np.pi * np.arange(points) / points
    return [(radius * float(np.cos(angle)), radius * float(np.sin(angle))) for angle in angles]


def frame_from_touches(T_base_f: Array, centers: Array, depth: float) -> Array:
    """T_base_f (4, 4) corrected by positions (n, 3) of the sensor's centre in {f} at a known depth.

    One touch corrects the height; three and more, by a plane of least squares, the tilt as well. The x-axis
    stays where it was but for the tilt.
    """
    if len(centers) < 3:
        return np.asarray(T_base_f @ at(0.0, 0.0, float(np.mean(centers[:, 2])) - depth))
    basis = np.column_stack([centers[:, :2], np.ones(len(centers))])
    slope_x, slope_y, height = np.linalg.lstsq(basis, centers[:, 2], rcond=None)[0]
    z = np.array([-slope_x, -slope_y, 1.0])
    z /= np.linalg.norm(z)
    x = np.array([1.0, 0.0, 0.0]) - z * z[0]
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    # the plane of the centers lies as deep as the touches were
    T[:3, 3] = np.array([0.0, 0.0, height]) - z * depth
    return np.asarray(T_base_f @ T)
