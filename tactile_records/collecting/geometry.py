"""Poses of data collection: the contact frame over a flat surface or an edge, where a sample's motion goes.

The frame {f} has its z into the surface, and its origin where the sensor's centre is at first touch: a tip's
radius off the surface. `X_fs` is the sensor in {f}; its z is the depth. On an edge, x is along it, and y
points to the side where the plate is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from tactile_geometry import se3
from tactile_records.collecting.settings import EdgeSettings, TouchSettings

Array = NDArray[np.float64]

_DEEPEST = 1.5e-3  # m; an edge has shown when the tip is so deep in it
_HALF_TURN = 3.0  # rad; beyond half a turn the shortest way would be the other one


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


def edge_frame(T_base_box: Array, size: Sequence[float], T_base_sensor: Array, radius: float) -> Array:
    """T_base_f (4, 4) on that edge of a box which is nearest to the sensor, of the face that it points at.

    `size` (3,) is the box's, along its axes from its middle. The origin is over the edge beside the sensor.

    Raises
    ------
    ValueError
        If the sensor points away from the box.
    """
    half = np.asarray(size) / 2.0
    T_box_sensor = se3.inverse(T_base_box) @ T_base_sensor
    into = int(np.argmax(np.abs(T_box_sensor[:3, 2])))
    z = np.sign(T_box_sensor[into, 2]) * np.eye(3)[into]
    place = T_box_sensor[:3, 3]
    if place @ z > -half[into]:
        raise ValueError("the sensor is beside or within the box: it must start over the face with the edge")
    sides = [axis for axis in range(3) if axis != into]
    across = min(sides, key=lambda axis: half[axis] - abs(place[axis]))
    outward = 1.0 if place[across] >= 0.0 else -1.0
    y = -outward * np.eye(3)[across]
    T_box_f = np.eye(4)
    T_box_f[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    T_box_f[:3, 3] = place
    T_box_f[across, 3] = outward * half[across]
    T_box_f[into, 3] = 0.0
    T_box_f[:3, 3] -= z * (half[into] + radius)
    return np.asarray(T_base_box @ T_box_f)


def above(pressed: Array, gap: float) -> Array:
    """X_fs (4, 4) in the air over a contact pose (6,), m and rad, turned as it will touch."""
    x, y, _, *angles = pressed
    return se3.pose_from_euler([x, y, -gap, *angles])


def turns_to(pressed: Array, gamma: float) -> list[Array]:
    """Contact poses (6,) to turn through over the last, which comes last, from an angle `gamma` (rad).

    They lead from 170 to -170 degrees back by 0, where the shortest way would wind up cables and wrist.
    """
    if abs(pressed[5] - gamma) < _HALF_TURN:
        return [pressed]
    between = pressed.copy()
    between[5] = (pressed[5] + gamma) / 2.0
    return [between, pressed]


def contact_depth(X_fs: Array, edge: EdgeSettings) -> float:
    """How deep (m) the tip is in what it touches; beside the plate it meets the edge, later than the face."""
    depth, beside = X_fs[2, 3], -X_fs[1, 3]
    if not edge.pressed or beside <= 0.0:
        return float(depth)
    return float(edge.tip_radius - np.hypot(beside, edge.tip_radius - depth))


def lifted(X_fs: Array, gap: float) -> Array:
    """X_fs (4, 4) straight off the surface from where it is; never nearer to it."""
    out = X_fs.copy()
    out[2, 3] = min(-gap, float(X_fs[2, 3]))
    return out


def at(x: float, y: float, z: float) -> Array:
    """X_fs (4, 4) at a position in {f}, untilted."""
    return se3.pose_from_euler([x, y, z, 0.0, 0.0, 0.0])


def places(settings: TouchSettings, edge: EdgeSettings) -> list[tuple[float, float]]:
    """Where to touch, x and y in {f}: the origin for one touch, else evenly on a circle.

    Of an edge they lie on the plate, and from three on there are four more beside it, that meet the edge.
    """
    middle = settings.radius + edge.reach if edge.pressed else 0.0
    if settings.points <= 1:
        return [(0.0, middle)] * settings.points
    angles = 2.0 * np.pi * np.arange(settings.points) / settings.points
    circle = settings.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1) + [0.0, middle]
    ends = [edge.reach, edge.reach / 2.0] if edge.pressed else []
    beside = [[x, -reach] for reach in ends for x in (-settings.radius, settings.radius)]
    return [(float(x), float(y)) for x, y in [*circle, *beside]]


def frame_from_touches(T_base_f: Array, centers: Array, settings: TouchSettings, edge: EdgeSettings) -> Array:
    """T_base_f (4, 4) corrected by positions (n, 3) of the sensor's centre in {f} at touches at `places`.

    One touch corrects the height; three and more, by a plane of least squares, the tilt as well. The x-axis
    stays where it was but for the tilt, or along the edge. Raises `ValueError` where the edge is not there.
    """
    if settings.points < 3:
        height = float(np.mean(centers[:, 2])) - settings.depth
        return np.asarray(T_base_f @ at(0.0, 0.0, height))
    plane, beside = centers[: settings.points], centers[settings.points :]
    basis = np.column_stack([plane[:, :2], np.ones(len(plane))])
    slope_x, slope_y, height = np.linalg.lstsq(basis, plane[:, 2], rcond=None)[0]
    z = np.array([-slope_x, -slope_y, 1.0])
    z /= np.linalg.norm(z)
    x = np.array([1.0, 0.0, 0.0]) - z * z[0]
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    # the plane of the centers lies as deep as the touches were
    T[:3, 3] = np.array([0.0, 0.0, height]) - z * settings.depth
    if edge.pressed:
        T = T @ _onto_edge((beside - T[:3, 3]) @ T[:3, :3], settings.depth, edge)
    return np.asarray(T_base_f @ T)


def _onto_edge(beside: Array, depth: float, edge: EdgeSettings) -> Array:
    """(4, 4) in the plane: from {f} to the edge that the tip has met at centers (4, 3) in {f}.

    The ball about a center at z is as deep as `shown` in the edge where that is sqrt((radius - shown)^2 -
    (radius - z)^2) aside. An edge shows later than a plate, how much later is found by touches at two
    distances from it.
    """
    radius = edge.tip_radius

    def gaps(shown: float) -> Array:
        return np.sqrt(np.maximum((radius - shown) ** 2 - (radius - beside[:, 2]) ** 2, 0.0))

    def residuals(values: Array) -> Array:
        angle, distance, shown = values
        inward = np.array([-np.sin(angle), np.cos(angle)])
        return np.asarray(beside[:, :2] @ inward + gaps(shown) - distance)

    if gaps(depth)[:2].min() < 0.6 * edge.reach:
        raise ValueError(
            f"no edge within {0.4 * edge.reach * 1e3:.0f} mm of where the scene says: {edge.reach * 1e3:.0f} "
            "mm beside it there is still plate"
        )
    ends = [-0.5, -radius, 0.0], [0.5, radius, _DEEPEST]
    start = [0.0, 0.0, np.clip(depth, 0.01 * _DEEPEST, 0.5 * _DEEPEST)]
    found = least_squares(residuals, start, bounds=ends, x_scale=[1e-2, 1e-3, 1e-3])
    angle, distance, _ = found.x
    T = se3.pose_from_euler([0.0, 0.0, 0.0, 0.0, 0.0, angle])
    T[:2, 3] = distance * np.array([-np.sin(angle), np.cos(angle)])
    return T
