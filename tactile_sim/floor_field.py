"""Friction that differs over the floor, and with the speed of what slides on it.

Over the floor it is a smooth random field: a sum of waves with random directions, lengths and phases, whose
correlation falls with distance as exp(-d^2 / 2 length^2) (Rahimi and Recht's random Fourier features). A foot
has the mean of the field under it, and its centre of friction moves to where there is more. With speed it
grows by a part for each tenfold of 10 mm/s.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_WAVES = 64
_LEAST = 0.1  # of the mean friction, that is left where the field is lowest
_USUAL_SPEED, _LEAST_SPEED = 0.01, 1e-4  # m/s


class FloorField:
    """Friction over its mean at points of the floor; the same for the same seed."""

    def __init__(self, deviation: float, length: float, seed: int) -> None:
        rng = np.random.default_rng([seed, 2])
        self._waves = rng.standard_normal((2, _WAVES)) / length
        self._phases = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
        self._size = deviation * math.sqrt(2.0 / _WAVES)

    def __call__(self, points: ArrayLike) -> Array:
        """At points (n, 2), m; of unit mean and the given standard deviation, (n,)."""
        phases = np.asarray(points) @ self._waves + self._phases
        return np.asarray((1.0 + self._size * np.cos(phases).sum(axis=1)).clip(_LEAST))

    def under(self, points: Array) -> tuple[float, Array]:
        """Mean over points that press evenly (n, 2), m, and how far their centre of friction is off (2,)."""
        friction = self(points)
        return float(friction.mean()), friction @ points / friction.sum() - points.mean(axis=0)


def speed_factor(speed: float, part: float) -> float:
    """Of friction at a speed (m/s) that grows by a part for each tenfold of it; 1 at 10 mm/s."""
    return max(1.0 + part * math.log10(max(speed, _LEAST_SPEED) / _USUAL_SPEED), _LEAST)
