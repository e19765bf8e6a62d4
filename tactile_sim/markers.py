"""Markers on pins inside the skin: where their tips are when the skin is displaced.

A pin stands on the inside of the skin along its normal, so that its tip shows both the displacement of the
skin and the turn of its normal. Both are interpolated from the skin nodes by moving least squares with
quadratic terms (weights fixed at the start), which is smooth where a linear mesh would show its edges.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from tactile_scene.simulated_sensors import MarkerSettings
from tactile_sim.skin import Skin, ring_directions

Array = NDArray[np.float64]
_NEIGHBORS = 16


class SkinPoints:
    """Points of one skin, each with the normal there.

    Attributes
    ----------
    normals : (n, 3)
        Outward, at rest.
    """

    def __init__(self, normals: Array, skin: Skin, radius: float) -> None:
        self.normals, self._base = normals, radius * normals
        self._tangents = _tangents(normals)
        self._interpolate = _interpolation(self._base, self._tangents, skin, radius)

    def moved(self, displacement: NDArray[np.float32]) -> tuple[Array, Array]:
        """Positions (n, 3) m in {s} and unit normals (n, 3) for displacements (nodes, 3) m of the skin."""
        moved, along, across = (self._interpolate @ displacement).reshape(3, len(self._base), 3)
        normal = np.cross(self._tangents[0] + along, self._tangents[1] + across)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return np.asarray(self._base + moved), normal


class Markers:
    """Tips of the pins of one skin, or none.

    Attributes
    ----------
    rest : (n, 3) m
        Marker positions with no contact, in {s}.
    """

    def __init__(self, settings: MarkerSettings, skin: Skin, radius: float, skin_thickness: float) -> None:
        directions = ring_directions(np.radians(settings.pitch_deg) * np.arange(settings.rings + 1))
        if settings.rings == 0:
            directions = directions[:0]
        if settings.worn > 0.0:
            directions = directions[np.random.default_rng(0).random(len(directions)) >= settings.worn]
        azimuth = np.radians(settings.azimuth_deg)
        c, s = np.cos(azimuth), np.sin(azimuth)
        normals = directions @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        self._depth = skin_thickness + settings.pin_length
        self._points = SkinPoints(normals, skin, radius)
        self.rest = (radius - self._depth) * normals

    def __len__(self) -> int:
        return len(self.rest)

    def positions(self, displacement: NDArray[np.float32]) -> Array:
        """Marker positions (n, 3) m in {s} for displacements (nodes, 3) m of the skin."""
        position, normal = self._points.moved(displacement)
        return np.asarray(position - self._depth * normal)


def _interpolation(base: Array, tangents: Array, skin: Skin, radius: float) -> csr_array:
    """Sparse (3 n, nodes) float32: values at the n markers, then their derivatives along both tangents."""
    neighbors, weights = _least_squares_weights(base, tangents, skin, radius)
    rows, count = 3 * len(base), neighbors.shape[1]
    values = weights.transpose(1, 0, 2).astype(np.float32).ravel()
    columns = np.tile(neighbors.ravel(), 3).astype(np.int32)
    starts = np.arange(0, rows * count + 1, count, dtype=np.int32)
    return csr_array((values, columns, starts), shape=(rows, len(skin.nodes)))


def _tangents(normals: Array) -> Array:
    """Two unit tangents (2, n, 3) with tangent 0 x tangent 1 = normal."""
    first = np.cross([0.0, 1.0, 0.0], normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first)])


def _least_squares_weights(
    base: Array, tangents: Array, skin: Skin, radius: float
) -> tuple[NDArray[np.intp], Array]:
    """Nodes (n, k) near each marker, and weights (n, 3, k) of the value and its two tangential derivatives.

    The derivatives are with respect to arc length on the sphere at the marker.
    """
    difference = skin.nodes[None] - base[:, None]
    order = np.argsort(np.linalg.norm(difference, axis=2), axis=1)[:, :_NEIGHBORS]
    near = np.take_along_axis(difference, order[:, :, None], axis=1)
    s, t = (np.einsum("nkd,nd->nk", near, tangent) / radius for tangent in tangents)
    basis = np.stack([np.ones_like(s), s, t, s * s, s * t, t * t], axis=2)
    reach = 1.05 * np.sqrt(s * s + t * t).max(axis=1, keepdims=True)
    taper = (1 - (s * s + t * t) / reach**2) ** 2
    weighted = basis * taper[:, :, None]
    solution = np.linalg.solve(basis.transpose(0, 2, 1) @ weighted, weighted.transpose(0, 2, 1))
    return order, solution[:, :3] / np.array([1.0, radius, radius])[None, :, None]
