"""The surfaces of a scene, for pictures of a run: all as one mesh, and the outline of what is moved."""

from __future__ import annotations

import numpy as np

from tactile_records.runs.record import LooseBody, SurfaceMesh
from tactile_scene.motions import CARRIED, FIXED
from tactile_scene.scene import Scene

# m from its origin where the search for its outline begins, and how long it is
LARGEST_BODY, STEPS = 0.5, 100


def surface_mesh(scene: Scene, arm: str, n: int = 60) -> SurfaceMesh:
    """All surfaces that the arm's sensor can touch, as one mesh in the arm's base, where they start."""
    vertices, faces, count = [], [], 0
    for name, body in scene.bodies_of(arm).items():
        points, triangles = body.make().mesh(n)
        T = scene.T_base_body(arm, name)
        vertices.append(points @ T[:3, :3].T + T[:3, 3])
        faces.append(triangles + count)
        count += len(points)
    return SurfaceMesh(np.concatenate(vertices), np.concatenate(faces)) if vertices else SurfaceMesh()


def loose_body(scene: Scene, arm: str) -> str:
    """The body that the arm's sensor can touch and a motion model moves: the first; '' without one."""
    names = (name for name, body in scene.bodies_of(arm).items() if body.motion not in (FIXED, CARRIED))
    return next(names, "")


def loose_outline(scene: Scene, arm: str, n: int = 180) -> LooseBody:
    """The loose body with its contour at the height of the sensor's start, as `n` rays to its origin meet it.

    Each ray is followed inwards by the distance to the surface, which it cannot pass, until it is there.
    """
    name = loose_body(scene, arm)
    if not name:
        return LooseBody()
    T = scene.T_world_body(name)
    center = T[:3, :3].T @ [0.0, 0.0, scene.arms[arm].T_world_start[2, 3] - T[2, 3]]
    angle = np.linspace(0.0, 2.0 * np.pi, n + 1)
    rays = np.stack([np.cos(angle), np.sin(angle), np.zeros(n + 1)], axis=1) @ T[:3, :3]
    surface, radius = scene.bodies[name].make(), np.full((n + 1, 1), LARGEST_BODY)
    for _ in range(STEPS):
        radius = np.maximum(radius - surface.distance(center + radius * rays)[:, None], 0.0)
    return LooseBody(center + radius * rays, T)
