"""The paper's filter experiment: a data set as a sequence of motions that are known up to noise."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tactile_filter import se3
from tactile_filter.bayes_filter import ContactFilter, FilterSettings
from tactile_perception.sources import Frame

Array = NDArray[np.float64]


def motion_covariance(sigma: float) -> Array:
    """Covariance (6, 6) in SI of a motion's noise of `sigma` mm and `sigma` degrees.

    Paper, eq. se3_filter_exp_state_trans_cov.
    """
    return np.diag(np.repeat([sigma * 1e-3, np.radians(sigma)], 3) ** 2)


def motion_filter(sigma: float) -> ContactFilter:
    """The paper's filter for motions known up to `sigma` mm and degrees: it fuses every measurement."""
    settings = FilterSettings(
        process_noise_translation=sigma * 1e-3,
        process_noise_rotation=float(np.radians(sigma)),
        gate_probability=1.0,
    )
    return ContactFilter(settings)


def with_motion_noise(frames: Iterable[Frame], sigma: float, seed: int) -> Iterator[Frame]:
    """The frames with the poses that noisy odometry would give: T_k = exp(psi^) X_k X_{k-1}^-1.

    Paper, eq. se3_filter_exp_state_trans_model; frames without a pose pass as they are.
    """
    rng = np.random.default_rng(seed)
    deviation = np.sqrt(np.diag(motion_covariance(sigma)))
    last: Array | None = None
    drifted = np.eye(4)
    for frame in frames:
        true = frame.T_base_sensor
        if true is None:
            yield frame
            continue
        if last is None:
            drifted = true
        else:
            motion = se3.exp(rng.normal(0.0, deviation)) @ se3.inverse(true) @ last
            drifted = se3.orthonormalized(drifted @ se3.inverse(motion))
        last = true
        yield replace(frame, T_base_sensor=drifted)
