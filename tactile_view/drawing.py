"""What is drawn of a cell: places of nodes, and the shapes of tips, cones and ways."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_geometry import se3

Array = NDArray[Any]

STALK = 0.12  # m, from the centre of the dome to the flange
EYE = np.array([0.13, -0.20, 0.11])  # m, from what is looked at
AROUND = np.radians([0, *(sign * angle for angle in range(20, 181, 20) for sign in (1, -1))])
TOUCH, FREE = 0.02, 0.04  # m, from the centre of a dome to what it touches; from a line of sight to a stalk
ROUND = np.linspace(0.0, 2.0 * np.pi, 25)


def place(handle: Any, T: Array) -> None:
    """Put a node where a pose (4, 4) in its parent's frame is."""
    x, y, z, w = se3.quaternion_from_rotation(T[:3, :3]).tolist()
    handle.wxyz, handle.position = (w, x, y, z), tuple(T[:3, 3].tolist())


def dome(radius: float, rings: int = 10) -> tuple[Array, Array]:
    """Vertices and triangles of a tip: half a sphere about the origin, +z, on a cylinder of its radius."""
    angles = np.linspace(0.5 * np.pi, 0.0, rings)
    profile = [(radius, -radius), *((radius * np.sin(a), radius * np.cos(a)) for a in angles)]
    columns = np.stack([np.cos(ROUND), np.sin(ROUND)], axis=1)
    vertices = np.array([[*(r * column), z] for r, z in profile for column in columns])
    n, faces = len(ROUND), []
    for ring in range(len(profile) - 1):
        for k in range(n - 1):
            a, b = ring * n + k, (ring + 1) * n + k
            faces += [(a, a + 1, b), (b, a + 1, b + 1)]
    return vertices, np.array(faces)


def way_ahead(tip: Array, ahead: Array) -> Array:
    """The way (n, 3) from the tip on: it is told twice a second, and the tip passes some points meanwhile."""
    while len(ahead) > 1 and se3.norm(tip - ahead[1]) < max(
        se3.norm(ahead[0] - ahead[1]), se3.norm(ahead[0] - tip)
    ):
        ahead = ahead[1:]
    return np.concatenate([tip[None], ahead])


def cone(mean: Array, cov: Array, scale: float, length: float = 0.02) -> Array:
    """Segments (N, 2, 3) in {f}: the surface normal as it may be within two standard deviations, scaled.

    `cov` (6, 6) as geometry_msgs has it: its rotation is fixed-axis in the sensor frame.
    """
    in_f = mean[:3, :3].T @ cov[3:, 3:] @ mean[:3, :3]
    root = np.linalg.cholesky(in_f[:2, :2] + 1e-18 * np.eye(2))
    tilts = 2.0 * scale * root @ np.stack([np.cos(ROUND[:-1]), np.sin(ROUND[:-1])])
    angles = np.minimum(np.linalg.norm(tilts, axis=0), 1.5)
    axes = tilts / np.maximum(np.linalg.norm(tilts, axis=0), 1e-12)
    ends = -length * np.stack(
        [np.sin(angles) * axes[1], -np.sin(angles) * axes[0], np.cos(angles)], axis=1
    )  # outwards, turned about the axis
    return np.stack([np.zeros_like(ends), ends], axis=1)


def se3_of(R: Array, p: Array) -> Array:
    """A pose (4, 4) of rotation and position."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T


def look_from(tips: Sequence[Array]) -> tuple[Array, Array]:
    """Where to look from and at (3,): the middle of tips (N, 4, 4), no stalk before what a tip touches."""
    if not len(tips):
        return EYE, np.zeros(3)
    centres, axes = np.array([T[:3, 3] for T in tips]), np.array([T[:3, 2] for T in tips])
    middle, contacts = centres.mean(axis=0), centres + TOUCH * axes
    stalks = (centres - np.linspace(0.25, 1.0, 16)[:, None, None] * STALK * axes).reshape(-1, 3)
    part = np.linspace(0.0, 1.0, 40)[:, None, None]

    def room(eye: Array) -> float:
        """The least distance of a line of sight from a stalk, as far as more of it is of use."""
        sights = (eye + part * (contacts - eye)).reshape(-1, 1, 3)
        return min(FREE, float(np.linalg.norm(sights - stalks, axis=2).min()))

    size = max(1.0, float(np.linalg.norm(centres - middle, axis=1).max()) / 0.06)
    turns = (se3.pose_from_euler([0.0, 0.0, 0.0, 0.0, 0.0, angle])[:3, :3] for angle in AROUND)
    eyes = [middle + size * (turn @ EYE) for turn in turns]
    return max(eyes, key=room), middle
