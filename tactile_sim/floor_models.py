"""Which law of friction a floor has for an object that is pushed over it.

- `ellipsoid`: the limit surface is an ellipsoid with the foot's arm of friction; needs no numbers.
- `points`: Coulomb's law at each of some points of support. They share the load as a pressure that is linear
  over them and has its centre where the moments say, so that those ahead carry more.
- `polynomial`: sum of (load' A load)^2 = 1 over positive semidefinite A, as fitted to real pushes. Loads are
  (f_x, f_y, m / length) over the friction in all, about its centre, in the body's axes; `length` is the
  radius of gyration of the foot.

`planar_friction` has the same laws for many loads at once, without springs; each step of an object is in C
(`_csrc/floor.c`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import SettingError
from tactile_sim.limit_surface import Foot

Array = NDArray[np.float64]
#: A model's name, its numbers, (n, 2) or (n, 9), and the length (m) of its loads, as C takes them.
FloorModel = tuple[str, Array, float]

MODELS = ("ellipsoid", "points", "polynomial")
MOST_POINTS = 400  # as in C
_FIELDS = 7  # of a foot that is evenly pressed, along each axis
_BESIDE = 1e-6  # m: off the foot, that is taken for rounding
_LOWER, _UPPER = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)


def floor_model(name: str, foot: Foot, points: ArrayLike, polynomial: ArrayLike, turn: Array) -> FloorModel:
    """A model's numbers, from settings; `SettingError` says what is wrong with them.

    Parameters
    ----------
    foot : Foot
        Along the world's axes, from the body's origin.
    points : (2 n,) m, x and y of each, in the body
    polynomial : (6 n,) xx, xy, xm, yy, ym, mm of each A, in the body
    turn : ndarray (2, 2)
        Of the body in the world at the start.
    """
    length = float(np.sqrt(np.trace(foot.spread)))
    if name == "points":
        return name, _points(foot, np.asarray(points, dtype=float), turn), length
    if name == "polynomial":
        return name, _squares(np.asarray(polynomial, dtype=float), turn), length
    return name, np.zeros((0, 2)), length


def even_points(foot: Foot) -> Array:
    """Points (n, 2) all over a foot: the middles of equal fields."""
    low, high = foot.corners.min(axis=0), foot.corners.max(axis=0)
    middles = low + (high - low) * ((np.arange(_FIELDS) + 0.5) / _FIELDS)[:, None]
    grid = np.stack(np.meshgrid(*middles.T), axis=-1).reshape(-1, 2)
    return np.array([point for point in grid if foot.inside(point) > 0.0])


def _points(foot: Foot, given: Array, turn: Array) -> Array:
    if not len(given):
        return even_points(foot)
    if len(given) % 2 or not 3 <= len(given) // 2 <= MOST_POINTS:
        raise SettingError(
            f"points: {len(given)} numbers, must be x and y of 3 to {MOST_POINTS} points one after the other"
        )
    points = given.reshape(-1, 2) @ turn.T
    for point, own in zip(points, given.reshape(-1, 2), strict=True):
        if (beside := -foot.inside(point)) > _BESIDE:
            raise SettingError(
                f"points: {own.tolist()} lies {1e3 * beside:.1f} mm beside what the body stands on"
            )
    return points


def _squares(given: Array, turn: Array) -> Array:
    if not len(given) or len(given) % 6:
        raise SettingError(
            f"polynomial: {len(given)} numbers, must be six for each matrix: xx, xy, xm, yy, ym, mm"
        )
    squares = np.zeros((len(given) // 6, 3, 3))
    squares[:, _LOWER, _UPPER] = squares[:, _UPPER, _LOWER] = given.reshape(-1, 6)
    least = np.linalg.eigvalsh(squares).min(axis=1) / np.abs(squares).max(axis=(1, 2)).clip(1e-300)
    if least.min() < -1e-6 or np.linalg.eigvalsh(squares.sum(axis=0))[0] <= 0.0:
        raise SettingError(
            "polynomial: each matrix must be positive semidefinite, and their sum definite, or friction is "
            f"not convex; the least eigenvalues over the largest elements are {least.round(6).tolist()}"
        )
    R = np.eye(3)
    R[:2, :2] = turn
    return np.asarray(R @ squares @ R.T).reshape(-1, 9)
