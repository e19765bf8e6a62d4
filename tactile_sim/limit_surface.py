"""Friction of a foot that slides on a floor: what force and torque it carries, and how it moves beyond.

The limit surface of Goyal, Ruina and Papadopoulos (1991) as the ellipsoid of Howe and Cutkosky (1996):
(f_x^2 + f_y^2) / F^2 + m^2 / M^2 = 1, with m about the centre of friction. A foot whose load lies inside
sticks; one that slides carries a load on it and moves along its normal, which is the motion that dissipates
most. What a step of an object needs of it is in C (`_csrc/limit_surface.c`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import SettingError
from tactile_sim import _contact

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Foot:
    """The convex polygon that a body stands on, counter-clockwise.

    Attributes
    ----------
    corners : ndarray (n, 2)
        m.
    center : ndarray (2,)
        Of its area, m.
    arm : float
        Mean distance of its area from there, m: the largest torque of friction over the largest force, for
        a pressure that is the same all over.
    spread : ndarray (2, 2)
        Second moments of its area about the center over the area, m^2.
    """

    corners: Array
    center: Array
    arm: float
    spread: Array

    @classmethod
    def around(cls, points: ArrayLike) -> Foot:
        """The convex hull of points (n, 2) m; raises `SettingError` where it has no area."""
        corners = _hull(np.asarray(points, dtype=float).reshape(-1, 2))
        if len(corners) < 3:
            raise SettingError(
                f"support: {len(corners)} corners after removal of those on one line, must be 3 or more "
                "that enclose an area"
            )
        a, b = corners, np.roll(corners, -1, axis=0)
        doubled = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        center = ((a + b) * doubled[:, None]).sum(axis=0) / (3 * doubled.sum())
        a, b, area = a - center, b - center, 0.5 * float(doubled.sum())
        products = [np.outer(p, q) for p, q in zip(a + b, a + b, strict=True)]
        own = [np.outer(p, p) + np.outer(q, q) for p, q in zip(a, b, strict=True)]
        cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        spread = sum(w * (p + q) for w, p, q in zip(cross / 24, products, own, strict=True)) / area
        return cls(corners, center, _mean_distance(corners - center) / area, np.asarray(spread))

    def inside(self, point: ArrayLike) -> float:
        """How far (m) a point (2,) lies inside the nearest edge; negative outside."""
        return _contact.foot_inside(self.numbers, point)[0]

    def edge_share(self, center: ArrayLike) -> float:
        """Part of the load on the edge that a centre of pressure (2,) is ahead to.

        A pressure that is linear over the foot leaves its far corner when its centre leaves the core of the
        area; from there the share grows to 1 with the centre on the edge.
        """
        return _contact.foot_edge_share(self.numbers, center)

    def edge_before(self, point: ArrayLike) -> tuple[Array, Array]:
        """The two corners (2,) of the edge that a point (2,) is nearest to, or farthest beyond."""
        _, first = _contact.foot_inside(self.numbers, point)
        return self.corners[first], self.corners[(first + 1) % len(self.corners)]

    @cached_property
    def numbers(self) -> tuple[Array, Array, Array]:
        """As C takes it: of each edge corner, inward normal and their product (n, 5); centre; spread."""
        along = np.roll(self.corners, -1, axis=0) - self.corners
        inward = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(*along.T)[:, None]
        offset = np.einsum("ij,ij->i", inward, self.corners)
        return np.column_stack([self.corners, inward, offset]), self.center, self.spread


def return_to_surface(
    load: Sequence[float],
    stiffness: Array,
    force: float,
    torque: float,
    model: tuple[str, Array, float] | None = None,
) -> tuple[Array, Array]:
    """How a foot on springs moves until it carries the rest of its load.

    Implicit Euler over the step (return mapping, as in plasticity): the motion is along the normal of the
    ellipsoid at the load that is left, so the result does not overshoot, however stiff the springs are.

    Parameters
    ----------
    load : (3,)
        f_x, f_y (N) and m (N m) about the centre of friction, if the foot stays where it is.
    stiffness : ndarray (3, 3)
        How fast the load falls as the foot moves. Symmetric but for springs that slip, whose friction falls
        with their press.
    force, torque : float
        Half axes F (N) and M (N m) of the ellipsoid, positive.
    model : tuple, optional
        A `floor_models.FloorModel` in place of the ellipsoid, with friction `force` in all.

    Returns
    -------
    motion : ndarray (3,)
        dx, dy (m) and turn (rad); zero for a load inside.
    left : ndarray (3,)
        The load that is carried then: inside or on the ellipsoid.

    Raises
    ------
    ValueError
        If what springs do not hold exceeds the ellipsoid: no position of the foot carries the load.
    """
    return _contact.return_to_surface(load, stiffness, force, torque, model)


def _hull(points: Array) -> Array:
    """Corners of the convex hull, counter-clockwise (Andrew's monotone chain)."""
    ordered = sorted({(float(x), float(y)) for x, y in points.round(9)})
    size = max((math.dist(ordered[0], p) for p in ordered), default=0.0)
    chains: list[list[tuple[float, float]]] = []
    for sweep in (ordered, ordered[::-1]):
        chain: list[tuple[float, float]] = []
        for p in sweep:
            while len(chain) >= 2 and _left_of(chain[-2], chain[-1], p) <= 1e-12 * size * size:
                chain.pop()
            chain.append(p)
        chains.append(chain[:-1])
    return np.array(chains[0] + chains[1]).reshape(-1, 2)


def _left_of(a: tuple[float, float], b: tuple[float, float], p: tuple[float, float]) -> float:
    return (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0])


def _mean_distance(corners: Array) -> float:
    """Integral of the distance from the origin over a polygon that is star-shaped about it, m^3.

    Of the triangle of the origin and an edge at distance d, seen under angles t0 to t1 from the
    perpendicular: d^3 / 6 [sec t tan t + ln(sec t + tan t)].
    """
    total = 0.0
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        length = math.dist(a, b)
        along = (b - a) / length
        d = float(a[0] * along[1] - a[1] * along[0])
        if d <= 0.0:
            continue
        for end, sign in ((b, 1.0), (a, -1.0)):
            tan = float(end @ along) / d
            sec = math.hypot(1.0, tan)
            total += sign * d**3 / 6 * (sec * tan + math.asinh(tan))
    return total
