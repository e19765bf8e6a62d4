"""The paper's filter experiment: a data set as a sequence of motions that are known up to noise."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tactile_filter import se3
from tactile_filter.bayes_filter import ContactFilter, FilterSettings
from tactile_perception.estimating.sources import Frame

Array = NDArray[np.float64]


def motion_covariance(sigma: float) -> Array:
    """Covariance (6, 6) in SI of a motion's noise of `sigma` mm and `sigma` degrees.

    Paper, eq. se3_filter_exp_state_trans_cov.
    """
    return np.diag(np.repeat([sigma * 1e-3, np.radians(sigma)], 3) ** 2)


def motion_filter(sigma: float, settings: FilterSettings | None = None) -> ContactFilter:
    """The paper's filter for motions known up to `sigma` mm and degrees: it fuses every measurement.

    `settings` give the rest; without them nothing is gated, as in the paper.
    """
    settings = settings or FilterSettings(gate_probability=1.0)
    noise = {
        "process_noise_translation": sigma * 1e-3,
        "process_noise_rotation": float(np.radians(sigma)),
    }
    return ContactFilter(settings.replaced(**noise))


def with_motion_noise(frames: Iterable[Frame], sigma: float, seed: int) -> Iterator[Frame]:
    """The frames with the poses that noisy odometry would give; frames without a pose pass as they are."""
    drift = Drift(sigma, seed)
    for frame in frames:
        true = frame.T_base_sensor
        yield frame if true is None else replace(frame, T_base_sensor=drift(true))


class Drift:
    """Poses of the sensor as noisy odometry gives them, one after the other: T_k = exp(psi^) X_k X_{k-1}^-1.

    Paper, eq. se3_filter_exp_state_trans_model.
    """

    def __init__(self, sigma: float, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._deviation = np.sqrt(np.diag(motion_covariance(sigma)))
        self._true: Array | None = None
        self._drifted = np.eye(4)

    def __call__(self, true: Array) -> Array:
        """The drifted pose (4, 4) that goes with the next true one."""
        if self._true is None:
            self._drifted = true
        else:
            noise = se3.exp(self._rng.normal(0.0, self._deviation))
            motion = noise @ se3.inverse(true) @ self._true
            self._drifted = se3.orthonormalized(self._drifted @ se3.inverse(motion))
        self._true = true
        return self._drifted
