"""A force sensor between the tool and the tactile sensor, as they are: it weighs, is off, and has noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_sim.frame import Frame

Array = NDArray[np.float64]

#: What hangs from it (N), how far a good one drifts from where it was set to zero, and its noise, as data
#: sheets of six-axis sensors for some ten newtons have it (ATI Nano17, SI-12-0.12: 1/320 N resolved).
WEIGHT, OFFSET, NOISE = 1.2, 0.3, 0.01


class ForceSensor:
    """Forces (3,) in {s}, N, by the seed.

    Parameters
    ----------
    seed : of offset and noise
    T_world_base : (4, 4), where the arm stands
    """

    def __init__(self, seed: int, T_world_base: Array) -> None:
        self._random = np.random.default_rng([seed, 17])
        self._offset = self._random.normal(0.0, OFFSET, 3)
        self._down = T_world_base[:3, :3].T @ np.array([0.0, 0.0, -WEIGHT])

    def measured(self, frame: Frame) -> Array:
        """At an exposure: the surface's force, weight, offset and noise."""
        weight = frame.T_base_sensor[:3, :3].T @ self._down
        noise = self._random.normal(0.0, NOISE, 3)
        return np.asarray(frame.truth.force + weight + self._offset + noise)
