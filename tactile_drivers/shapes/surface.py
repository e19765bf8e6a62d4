"""What every shape answers: signed distance, outward normal and a mesh, each in its own frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import Settings

Array = NDArray[np.float64]


class Surface(ABC):
    """A rigid surface in its own frame.

    Subclasses name their `Settings` class and implement `query` and `grid`.

    Parameters
    ----------
    settings : Settings, optional
        Of the subclass's `settings_class`; its defaults if left out.
    """

    settings_class: ClassVar[type[Settings]]

    def __init__(self, settings: Any = None) -> None:
        self.settings = settings or self.settings_class()

    @abstractmethod
    def query(self, points: Array) -> tuple[Array, Array]:
        """Signed distance (N,) in m and outward unit normal (N, 3) at `points` (N, 3) in m."""

    @abstractmethod
    def grid(self, n: int = 60) -> Array:
        """Points (rows, columns, 3) in m on the part of the surface that is worth drawing.

        About `n` each way. The direction along a row cross that to the next row points outward.
        """

    def distance(self, points: Array) -> Array:
        """Signed distance (N,) of `points` (N, 3) in m, positive outside."""
        return self.query(points)[0]

    def normal(self, points: Array) -> Array:
        """Outward unit normal (N, 3) at `points` (N, 3): the gradient of the distance."""
        return self.query(points)[1]

    def closest(self, points: Array) -> Array:
        """Points (N, 3) of the surface that are nearest to `points` (N, 3), in m."""
        distance, normal = self.query(points)
        return points - distance[:, None] * normal

    def mesh(self, n: int = 60) -> tuple[Array, NDArray[np.int64]]:
        """Vertices (V, 3) in m and triangles (F, 3), counter-clockwise from outside, of `grid(n)`."""
        points = self.grid(n)
        rows, columns = points.shape[:2]
        index = np.arange(rows * columns).reshape(rows, columns)
        a, b, c, d = (
            block.ravel() for block in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
        )
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        return points.reshape(-1, 3), faces
