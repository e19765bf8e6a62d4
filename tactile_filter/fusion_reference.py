"""Fusion of two Gaussians over poses in plain NumPy: the paper's Algorithm "SE(3) data fusion", to be read.

`tactile_filter.fusion` is the same in C; the tests hold the two together. Minimized over X is

    |L1^-1 log(X X1^-1)|^2 + |L2^-1 log(X X2^-1)|^2,      Sigma_k = L_k L_k^T,

by Gauss-Newton steps X <- exp(mu^) X from X = X1. The paper writes its normal equations with the inverses of
the covariances; here their Cholesky factors whiten the Jacobians, which says the same without inverting
anything.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_filter import se3
from tactile_filter.fusion_result import CONVERGED_STEP, FusionResult, FusionStatus

Array = NDArray[np.float64]

EXACT = "exact"
EXACT_TOLERANCE = 1e-13  # step, relative to 1 + the whitened residual: where rounding takes over
FLOOR_TOLERANCE = 1e-9  # below this, a step that no longer shrinks is rounding, too
ARMIJO = 1e-4  # fraction of the predicted decrease that a step has to bring
SEARCH_FROM = 1e-3  # shorter steps are taken whole: they change the cost by less than its rounding
SLACK = 1e-12  # differences of costs below this fraction are rounding
SHORTEST_STEP = 2.0**-30


def fuse_fixed(
    mean_1: ArrayLike,
    cov_1: ArrayLike,
    mean_2: ArrayLike,
    cov_2: ArrayLike,
    iterations: int = 5,
    jacobian_order: int | str = 2,
) -> FusionResult:
    """The published algorithm: a fixed number of steps, the covariance as evaluated before the last of them.

    `jacobian_order` is 2 (the paper's), 4, or "exact". The arguments have to be valid: nothing is checked.
    """
    factors = _factors(mean_1, cov_1, mean_2, cov_2)
    X = np.array(mean_1, dtype=np.float64)
    for _ in range(iterations):
        A, residual = _whitened(X, factors, jacobian_order)
        N, mu, step = _gauss_newton(A, residual)
        X = se3.exp(mu) @ X
    status = FusionStatus.CONVERGED if step <= CONVERGED_STEP else FusionStatus.NOT_CONVERGED
    return _result(X, N, iterations, status, step)


def fuse_exact(
    mean_1: ArrayLike, cov_1: ArrayLike, mean_2: ArrayLike, cov_2: ArrayLike, iterations: int = 100
) -> FusionResult:
    """To convergence with the exact Jacobian: each step is halved until it lowers the cost."""
    factors = _factors(mean_1, cov_1, mean_2, cov_2)
    X = np.array(mean_1, dtype=np.float64)
    previous = np.inf
    for count in range(1, iterations + 1):
        A, residual = _whitened(X, factors, EXACT)
        N, mu, step = _gauss_newton(A, residual)
        scale = 1.0 + float(np.sqrt(residual @ residual))
        at_floor = step <= FLOOR_TOLERANCE * scale and step > 0.5 * previous
        if step <= EXACT_TOLERANCE * scale or at_floor:
            return _result(X, N, count, FusionStatus.CONVERGED, step)
        moved = _line_search(X, mu, step, float(residual @ residual), factors)
        if moved is None:
            return _result(X, N, count, FusionStatus.STALLED, step)
        X, previous = moved, step
    return _result(X, N, iterations, FusionStatus.NOT_CONVERGED, step)


def _factors(
    mean_1: ArrayLike, cov_1: ArrayLike, mean_2: ArrayLike, cov_2: ArrayLike
) -> list[tuple[Array, Array]]:
    """Inverse of the mean and Cholesky factor of the covariance, for both."""
    pairs = ((mean_1, cov_1), (mean_2, cov_2))
    return [(se3.inverse(mean), np.linalg.cholesky(np.asarray(cov))) for mean, cov in pairs]


def _whitened(X: Array, factors: list[tuple[Array, Array]], jacobian_order: int | str) -> tuple[Array, Array]:
    """L_k^-1 J(xi_k)^-1 stacked (12, 6), and L_k^-1 xi_k stacked (12,), where xi_k = log(X X_k^-1)."""
    rows, residuals = [], []
    for inverse_mean, L in factors:
        xi = se3.log(X @ inverse_mean)
        rows.append(np.linalg.solve(L, _inverse_jacobian(xi, jacobian_order)))
        residuals.append(np.linalg.solve(L, xi))
    return np.concatenate(rows), np.concatenate(residuals)


def _inverse_jacobian(xi: Array, order: int | str) -> Array:
    if order == EXACT:
        return se3.inverse_left_jacobian(xi)
    return se3.inverse_left_jacobian_series(xi, int(order))


def _gauss_newton(A: Array, residual: Array) -> tuple[Array, Array, float]:
    """N lower triangular with A^T A = N^T N, the step mu = -(A^T A)^-1 A^T residual, and |N mu|."""
    N = np.linalg.cholesky((A.T @ A)[::-1, ::-1])[::-1, ::-1].T
    y = -np.linalg.solve(N.T, A.T @ residual)
    return np.asarray(N, dtype=np.float64), np.linalg.solve(N, y), float(np.sqrt(y @ y))


def _line_search(
    X: Array, mu: Array, step: float, cost: float, factors: list[tuple[Array, Array]]
) -> Array | None:
    """The pose after the longest of the steps mu, mu/2, mu/4, ... that lowers the cost enough, or None."""
    if step <= SEARCH_FROM:
        return se3.exp(mu) @ X
    fraction = 1.0
    while fraction >= SHORTEST_STEP:
        moved = se3.exp(fraction * mu) @ X
        _, residual = _whitened(moved, factors, EXACT)
        if float(residual @ residual) <= cost - 2.0 * ARMIJO * fraction * step * step + SLACK * cost:
            return moved
        fraction *= 0.5
    return None


def _result(X: Array, N: Array, iterations: int, status: FusionStatus, step: float) -> FusionResult:
    """Covariance (N^T N)^-1 from its factor N^-1, and the mean with rounding taken out of its rotation."""
    factor = np.tril(np.linalg.inv(N))
    return FusionResult(se3.orthonormalized(X), factor @ factor.T, factor, iterations, status, step)
