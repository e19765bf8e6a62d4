"""Offline smoothing: what each belief would have been if all that came later had been known.

Rauch, Tung and Striebel's backward pass over the filter's forward pass, on SE(3) with perturbations on the
left. Between steps k and k + 1 the filter believed X_k = exp(a^) F with a ~ N(0, P) and predicted
X_{k+1} = exp(p^) M with M = T F, p = Ad(T) a + w. Given p, a is N(G p, (I - G Ad) P (I - G Ad)^T + G Q G^T)
with G = P Ad^T (Ad P Ad^T + Q)^-1. The smoothed X_{k+1} = exp(s^) S stands off the prediction by
delta = log(S M^-1): p = delta + J(delta)^-1 s, and the smoothed X_k = exp(J(G delta) eta) exp(G delta) F
with the rest eta of a. All sums are of semi-definite terms: the covariance cannot become indefinite.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dposv

from tactile_filter.belief import Belief, BeliefFlag
from tactile_filter.filter_settings import FilterSettings, Tuning
from tactile_filter.propagation import predict
from tactile_geometry import se3

Array = NDArray[np.float64]

_IDENTITY = np.eye(6)


def smooth(
    beliefs: Sequence[Belief], poses: Sequence[ArrayLike], settings: FilterSettings | None = None
) -> list[Belief]:
    """Smooth the beliefs of a run of the filter: other means and covariances, all else as it was.

    A belief that did not advance in time is that of the step before it; one that is not valid stays as it is.
    Nothing is carried back over a restart of the filter.
    Raises `ValueError` if the numbers of beliefs and poses differ, or a belief's covariance is none.

    Parameters
    ----------
    beliefs : what `ContactFilter.step` answered, in that order
    poses : sequence of (4, 4) T_base_sensor of each step
    settings : those of the filter: the process noise is taken from them
    """
    if len(beliefs) != len(poses):
        raise ValueError(f"{len(beliefs)} beliefs and {len(poses)} poses: must be as many")
    tuning = Tuning.of(FilterSettings() if settings is None else settings)
    smoothed = list(beliefs)
    later: int | None = None  # the step after this one in time
    for k in range(len(beliefs) - 1, -1, -1):
        if not beliefs[k].valid:
            later = None
            continue
        if k > 0 and beliefs[k - 1].valid and beliefs[k - 1].stamp_ns == beliefs[k].stamp_ns:
            continue  # it repeats the belief before it
        if later is not None:
            elapsed_ns = beliefs[later].stamp_ns - beliefs[k].stamp_ns
            T_next = np.asarray(poses[later], dtype=np.float64)
            mean, cov = _backward(
                beliefs[k], smoothed[later], np.asarray(poses[k]), T_next, tuning.noise_since(elapsed_ns)
            )
            smoothed[k] = dataclasses.replace(beliefs[k], mean=mean, cov=cov)
        later = None if beliefs[k].flags & BeliefFlag.REINITIALIZED else k
    return _with_repetitions(beliefs, smoothed)


def _with_repetitions(beliefs: Sequence[Belief], smoothed: list[Belief]) -> list[Belief]:
    for k in range(1, len(beliefs)):
        same = beliefs[k - 1].valid and beliefs[k].valid and beliefs[k - 1].stamp_ns == beliefs[k].stamp_ns
        if same:
            last = smoothed[k - 1]
            smoothed[k] = dataclasses.replace(beliefs[k], mean=last.mean, cov=last.cov)
    return smoothed


def _backward(
    belief: Belief, following: Belief, T_now: Array, T_next: Array, variances: Array
) -> tuple[Array, Array]:
    """Mean and covariance of the step before the one that is smoothed already."""
    mean, cov = predict(belief.mean, belief.cov, T_now, T_next, variances)
    adjoint = se3.adjoint(se3.inverse(T_next) @ T_now)
    _, solved, failed = dposv(cov, adjoint @ belief.cov, lower=1)
    if failed:
        raise ValueError(
            f"belief of {belief.stamp_ns} ns: its prediction's covariance is not positive definite"
        )
    gain = solved.T
    delta = se3.log(following.mean @ se3.inverse(mean))
    shift = gain @ delta
    kept = _IDENTITY - gain @ adjoint
    carried = gain @ se3.inverse_left_jacobian(delta)
    cov = kept @ belief.cov @ kept.T + (gain * variances) @ gain.T + carried @ following.cov @ carried.T
    jacobian = se3.left_jacobian(shift)
    cov = jacobian @ cov @ jacobian.T
    return se3.orthonormalized(se3.exp(shift) @ belief.mean), 0.5 * (cov + cov.T)
