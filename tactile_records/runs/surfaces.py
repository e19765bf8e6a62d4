"""The surfaces of a scene as one mesh, for pictures of a run."""

from __future__ import annotations

import numpy as np

from tactile_drivers.scene import Scene
from tactile_records.runs.record import SurfaceMesh


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
