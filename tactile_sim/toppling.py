"""An object on the floor that tilts about an edge of its foot, and topples.

It tilts when the moments about the edge of the tips' forces and of the weight leave nothing for the rest of
the foot to press::

    sum_i (p_i - e) x f_i + (g - e) x W  about the edge  > 0

A push F at a height h turns it over the edge, its weight at a distance l behind the edge holds it, and so
does a tip at the back, a distance d behind the edge, that presses down by P; one at the front that lifts by
L unloads the edge. With friction mu_e at an edge that has caught, F = mu_e (W + P - L), so that it stands
while::

    mu_e h (W + P - L) < l W + d P

Once tilted it turns until the skins, which the turn stretches, hold it; where they do not before its centre
of gravity is above the edge, it has toppled. Assumed: no inertia, and an edge that stays on the floor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_LARGEST_TURN = 0.02  # rad a step


@dataclass(frozen=True)
class Touch:
    """The force of one tip on an object, while that stays where it is in this step; all in the world.

    Attributes
    ----------
    force, point : ndarray (3,)
        N, and where it acts, m.
    normal : ndarray (3,)
        Of the body, outward.
    along, across : float
        Stiffness of the skin, N/m.
    slips : bool
        Whether the force is what the friction of the skin leaves of it.
    """

    force: Array
    point: Array
    normal: Array
    along: float
    across: float
    slips: bool

    @property
    def stiffness(self) -> Array:
        """(3, 3): how fast the force falls as the object gives way; across, not while the skin slips."""
        across = 0.0 if self.slips else self.across
        return (self.along - across) * np.outer(self.normal, self.normal) + across * np.eye(3)


class Tipping:
    """How far an object is tilted about an edge of its foot."""

    def __init__(self) -> None:
        self.angle = 0.0  # rad
        self.over = False
        self.edge: tuple[Array, Array] | None = None  # that it is tilted about; None while it stands

    @property
    def arm(self) -> float:
        """Mean distance of the edge's points from its middle, m."""
        return 0.0 if self.edge is None else math.dist(*self.edge) / 4

    def step(
        self,
        edge: tuple[Array, Array],
        to_world: Callable[[Array], Array],
        touches: Sequence[Touch],
        center_of_gravity: Array,
        weight: float,
    ) -> Array:
        """Turn until the moments about the edge balance, and return the tilt (4, 4) in the world.

        Parameters
        ----------
        edge : two ndarray (2,)
            Corners of the foot, counter-clockwise: of the edge that it tilts about if it stands now.
        to_world : callable
            Takes a corner to the floor.
        """
        self.edge = self.edge or edge
        a, b = (np.append(to_world(corner), 0.0) for corner in self.edge)
        axis = (b - a) / np.linalg.norm(b - a)
        behind = float(np.cross(axis, center_of_gravity - a)[2])  # of the centre of gravity
        height = float(center_of_gravity[2])
        moment, stiffness = -weight * behind, -weight * height
        for touch in touches:
            way = np.cross(axis, touch.point - a)
            moment += float(way @ touch.force)
            stiffness += float(way @ touch.stiffness @ way)
        turn = math.copysign(_LARGEST_TURN, moment)
        if stiffness > 0:
            turn = max(-_LARGEST_TURN, min(_LARGEST_TURN, moment / stiffness))
        self.angle = max(0.0, self.angle + turn)
        self.over = behind <= 0.0
        if self.over:
            self.angle = math.pi / 2
        if self.angle == 0.0:
            self.edge = None
        return _about(axis, a, self.angle)


def _about(axis: Array, point: Array, angle: float) -> Array:
    """The turn (4, 4) about a horizontal axis (3,) through a point (3,)."""
    x, y = float(axis[0]), float(axis[1])
    c, s = math.cos(angle), math.sin(angle)
    T = np.eye(4)
    T[:3, :3] = [
        [c + x * x * (1 - c), x * y * (1 - c), y * s],
        [x * y * (1 - c), c + y * y * (1 - c), -x * s],
        [-y * s, x * s, c],
    ]
    T[:3, 3] = point - T[:3, :3] @ point
    return T
