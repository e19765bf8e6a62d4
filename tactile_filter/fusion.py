"""Fusion of two Gaussians over poses into one: the correction step of the filter, in C.

The algorithm is the paper's "SE(3) data fusion" (its Algorithm, after Barfoot and Furgale);
`test/filter/fusion_reference.py` is the same in NumPy, to be read. One pair at a time: what fusing many side
by side could save filters is measured in docs/fusion.md.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import unknown_name
from tactile_filter import _fusion

Array = NDArray[np.float64]

# Mode -> its number of iterations and its Jacobian order.
MODES: dict[str, tuple[int, int | str]] = {"paper": (5, 2), "fast": (3, "exact"), "exact": (100, "exact")}
JACOBIAN_ORDERS: dict[int | str, int] = {2: 2, 4: 4, "exact": 0}

_TO_CONVERGENCE = -1
_INPUTS = ("mean_1", "cov_1", "mean_2", "cov_2")

# A last step below this many posterior standard deviations counts as converged (fixed number of iterations).
CONVERGED_STEP = 1e-3


class FusionError(ValueError):
    """An input that cannot be fused; the message names the matrix and what is wrong with it."""


class FusionStatus(IntEnum):
    """How a fusion ended.

    Attributes
    ----------
    CONVERGED
        The last step was below the tolerance: `CONVERGED_STEP`, or rounding in mode "exact".
    NOT_CONVERGED
        The iterations ended before.
    STALLED
        Mode "exact" only: from no start was a minimum found. The cost is lowest where a mean is a half turn
        away and the logarithm jumps, so that the two inputs contradict each other by many standard
        deviations. The mean is the best one found.
    """

    CONVERGED = 0
    NOT_CONVERGED = 1
    STALLED = 2


class FusionResult(NamedTuple):
    """The fused Gaussian.

    Attributes
    ----------
    mean : (4, 4) pose
    cov : (6, 6) left covariance, equal to ``factor @ factor.T`` and thus symmetric and never indefinite
    factor : (6, 6) lower triangular
    iterations : steps taken
    status : FusionStatus
    step : length of the last step in posterior standard deviations: how far from converged it is
    """

    mean: Array
    cov: Array
    factor: Array
    iterations: int
    status: FusionStatus
    step: float


def fuse(
    mean_1: ArrayLike,
    cov_1: ArrayLike,
    mean_2: ArrayLike,
    cov_2: ArrayLike,
    mode: str = "paper",
    *,
    iterations: int | None = None,
    jacobian_order: int | str | None = None,
) -> FusionResult:
    """Normalized product of two Gaussians over poses, approximated by one.

    A fusion that has not converged is an answer, too: see its `status`. `FusionError` if an input is no pose
    or no covariance, or the two cannot be fused in double precision; `ValueError` if an array has the wrong
    shape or an option is unknown.

    Parameters
    ----------
    mean_1, mean_2 : (4, 4) poses
    cov_1, cov_2 : (6, 6) left covariances, symmetric and positive definite
    mode : {"paper", "fast", "exact"}
        "paper": 5 iterations with the inverse Jacobian of order 2, and the covariance as it was before the
        last update, as published. "fast": 3 iterations with the exact Jacobian. "exact": to convergence with
        the exact Jacobian and a line search, the covariance at the answer.
    iterations : another number of iterations than the mode's; in mode "exact" the most it may take
    jacobian_order : {2, 4, "exact"}, another order than the mode's
    """
    # Tens of nanoseconds count: the usual call goes straight to C, which knows the modes and calls `_refuse`.
    if iterations is None and jacobian_order is None:
        try:
            return _fuse(mean_1, cov_1, mean_2, cov_2, mode)
        except KeyError:
            pass  # no mode, as `_plan` will say
    return _fuse(mean_1, cov_1, mean_2, cov_2, _plan(mode, iterations, jacobian_order))


def check_gaussian(mean: ArrayLike, cov: ArrayLike, name: str) -> None:
    """Raise FusionError, naming the Gaussian, if a filter cannot take this mean and covariance.

    That is what `fuse` would not take, and what further steps may overflow with.
    """
    code = _fusion.check(mean, cov)
    if code:
        raise FusionError(_fault(code, (mean, cov), (f"{name}, mean", f"{name}, covariance")))


def _plan(mode: str, iterations: int | None, jacobian_order: int | str | None) -> tuple[int, int]:
    """Number of iterations and order as `_fusion.fuse` takes them."""
    if mode not in MODES:
        raise ValueError(f"mode: {unknown_name(mode, tuple(MODES))}")
    count, order = MODES[mode]
    count = count if iterations is None else iterations
    order = order if jacobian_order is None else jacobian_order
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ValueError(f"iterations = {count!r}: must be an integer of at least 1")
    if order not in JACOBIAN_ORDERS:
        raise ValueError(f"jacobian_order = {order!r}: must be one of 2, 4, 'exact'")
    if mode == "exact":
        if order != "exact":
            raise ValueError(f"jacobian_order = {order!r}: mode 'exact' needs the exact one")
        return count, _TO_CONVERGENCE
    return count, JACOBIAN_ORDERS[order]


def _refuse(code: int, inputs: tuple[ArrayLike, ...]) -> NoReturn:
    raise FusionError(_fault(code, inputs))


def _fault(code: int, inputs: tuple[ArrayLike, ...], names: tuple[str, ...] = _INPUTS) -> str:
    """What is wrong with the argument at which `_fusion` has found a fault."""
    index, lack = divmod(code, 16)
    if lack == 5:
        return (
            "the two covariances cannot be combined in double precision: their ratio, or the "
            "separation of the means in standard deviations, is too large"
        )
    name, matrix = names[index], np.asarray(inputs[index], dtype=np.float64)
    if lack == 6 and index % 2 == 0:
        return f"{name}: is further away than 1e9 m: {matrix[:3, 3].tolist()}"
    if lack == 6:
        return f"{name}: has variances outside [1e-30, 1e18]: {matrix.diagonal().tolist()}"
    return f"{name}: {_covariance_fault(matrix) if lack == 4 else _pose_fault(matrix)}"


def _pose_fault(mean: Array) -> str:
    if not np.isfinite(mean).all():
        return f"is not finite: {mean.tolist()}"
    if mean[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        return f"last row must be [0, 0, 0, 1], is {mean[3].tolist()}"
    R = mean[:3, :3]
    error = np.abs(R.T @ R - np.eye(3)).max()
    return f"is no pose: R^T R is off the identity by {error:.3g}, det R = {np.linalg.det(R):.3g}"


def _covariance_fault(cov: Array) -> str:
    if not np.isfinite(cov).all():
        return f"is not finite: {cov.tolist()}"
    size = np.abs(cov).max() or 1.0
    cov = cov / size  # what overflows would have no eigenvalues
    eigenvalues = size * np.linalg.eigvalsh(0.5 * (cov + cov.T))
    smallest = f"smallest eigenvalue {eigenvalues[0]:.6g}, largest {eigenvalues[-1]:.6g}"
    row, column = np.unravel_index(np.abs(cov - cov.T).argmax(), cov.shape)
    difference = abs(cov[row, column] - cov[column, row])
    if difference > 1e-8 * np.sqrt(abs(cov[row, row] * cov[column, column])):
        return (
            f"is not symmetric: elements [{row}, {column}] and [{column}, {row}] differ by "
            f"{size * difference:.3g}; of its symmetric part the {smallest}"
        )
    return f"is not positive definite: {smallest}"


_PLANS = {mode: _plan(mode, None, None) for mode in MODES}
_fusion.set_up(FusionResult, tuple(FusionStatus), _PLANS, _refuse)
_fuse = _fusion.fuse
