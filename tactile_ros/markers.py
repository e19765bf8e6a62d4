"""Markers for RViz: meshes of surfaces."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, Vector3
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker

from tactile_ros.conversions import pose_from_matrix

SURFACE_COLOR = (0.72, 0.74, 0.78, 1.0)


def mesh_marker(
    frame_id: str,
    name: str,
    number: int,
    T_frame_mesh: NDArray[np.float64],
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    color: tuple[float, float, float, float] = SURFACE_COLOR,
) -> Marker:
    """A marker that stays: triangles `faces` (F, 3) over `vertices` (V, 3) in m, at a pose in the frame."""
    marker = Marker(ns=name, id=number, type=Marker.TRIANGLE_LIST, action=Marker.ADD)
    marker.header.frame_id = frame_id
    marker.pose = pose_from_matrix(T_frame_mesh)
    marker.scale = Vector3(x=1.0, y=1.0, z=1.0)
    red, green, blue, alpha = color
    marker.color = ColorRGBA(r=red, g=green, b=blue, a=alpha)
    corners = vertices[faces.ravel()].tolist()
    marker.points = [Point(x=x, y=y, z=z) for x, y, z in corners]
    return marker
