"""Fusion of two Gaussians over poses in plain NumPy: the paper's Algorithm "SE(3) data fusion", to be read.

`tactile_filter.fusion` is the same in C; the tests beside this hold the two together. Minimized over X is

    |L1^-1 log(X X1^-1)|^2 + |L2^-1 log(X X2^-1)|^2,      Sigma_k = L_k L_k^T,

by Gauss-Newton steps X <- exp(mu^) X from X = X1. The paper writes its normal equations with the inverses of
the covariances; here their Cholesky factors whiten the Jacobians, and an orthogonal transformation takes the
place of the normal equations, which says the same without inverting or squaring anything.
"""

from __future__ import annotations

import numpy as np
import se3_reference as plain
from numpy.typing import ArrayLike, NDArray

from tactile_filter.fusion import CONVERGED_STEP, FusionResult, FusionStatus
from tactile_geometry import se3

Array = NDArray[np.float64]
Factors = list[tuple[Array, Array]]

EXACT = "exact"
EXACT_TOLERANCE = 1e-14  # step, relative to 1 + the whitened residual: where rounding takes over
FLOOR_TOLERANCE = 1e-9  # below this, a step that no longer shrinks is rounding, too
SLOW = 0.02  # a step longer than this fraction of the last one: Newton's method from here on
ARMIJO = 1e-4  # fraction of the predicted decrease that a step has to bring
SEARCH_FROM = 1e-3  # shorter steps are taken whole: they change the cost by less than its rounding
SLACK = 1e-12  # differences of costs below this fraction are rounding
SHORTEST_STEP = 2.0**-30
FAR = 0.3  # 1 - cos of the angle from which on several minima are looked for
DIFFERENCE = 1e-5  # of Newton's second derivatives, in posterior standard deviations


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
        factor, descent, _ = _gauss_newton(X, factors, jacobian_order)
        X = plain.exp(factor @ descent) @ X
    step = float(np.linalg.norm(descent))
    status = FusionStatus.CONVERGED if step <= CONVERGED_STEP else FusionStatus.NOT_CONVERGED
    return _result(X, factor, iterations, status, step)


def fuse_exact(
    mean_1: ArrayLike, cov_1: ArrayLike, mean_2: ArrayLike, cov_2: ArrayLike, iterations: int = 100
) -> FusionResult:
    """To convergence with the exact Jacobian; from several starts where the means are far apart."""
    factors = _factors(mean_1, cov_1, mean_2, cov_2)
    means = [np.array(mean, dtype=np.float64) for mean in (mean_1, mean_2)]
    best = _descend(means[0], factors, iterations)
    pairs = (means, (best.mean, means[0]), (best.mean, means[1]))
    if best.status == FusionStatus.CONVERGED and all(_versine(a, b) <= FAR for a, b in pairs):
        return best
    lowest = _cost(best.mean, factors)
    for start in _starts(*means):
        found = _descend(start, factors, iterations)
        cost = _cost(found.mean, factors)
        settled, was = found.status == FusionStatus.CONVERGED, best.status == FusionStatus.CONVERGED
        if settled > was or (settled == was and cost < lowest - 1e-9 * (1.0 + lowest)):
            best, lowest = found, cost
    return best


def _descend(X: Array, factors: Factors, iterations: int) -> FusionResult:
    """Gauss-Newton from X, Newton from where that is slow; each step is halved until it lowers the cost."""
    previous, slow = np.inf, False
    for count in range(1, iterations + 1):
        factor, descent, cost = _gauss_newton(X, factors, EXACT)
        step = float(np.linalg.norm(descent))
        scale = 1.0 + np.sqrt(cost)
        at_floor = step <= FLOOR_TOLERANCE * scale and step > 0.5 * previous
        if step <= EXACT_TOLERANCE * scale or at_floor:
            return _result(plain.exp(factor @ descent) @ X, factor, count, FusionStatus.CONVERGED, step)
        slow = slow or step > SLOW * previous
        moved = (
            _line_search(X, factor, _newton(X, factor, descent, factors), descent, cost, factors)
            if slow
            else None
        )
        if moved is None:
            moved = _line_search(X, factor, descent, descent, cost, factors)
        if moved is None:
            return _result(X, factor, count, FusionStatus.STALLED, step)
        X, previous = moved, step
    return _result(X, factor, iterations, FusionStatus.NOT_CONVERGED, step)


def _starts(mean_1: Array, mean_2: Array) -> list[Array]:
    """The second mean, and points between the two on the short and on the long way round."""
    between = mean_2 @ plain.inverse(mean_1)
    phi = plain.log(between)[3:]
    angle = float(np.linalg.norm(phi))
    starts = [mean_2]
    for turn in (1.0, 1.0 - 2.0 * np.pi / angle if angle else 1.0):
        around = np.concatenate((np.zeros(3), turn * phi))
        around[:3] = plain.inverse_left_jacobian(around)[:3, :3] @ between[:3, 3]
        starts += [plain.exp(fraction * around) @ mean_1 for fraction in (0.25, 0.5, 0.75)]
    return starts


def _factors(mean_1: ArrayLike, cov_1: ArrayLike, mean_2: ArrayLike, cov_2: ArrayLike) -> Factors:
    """Inverse of the mean and Cholesky factor of the covariance, for both."""
    pairs = ((mean_1, cov_1), (mean_2, cov_2))
    return [(plain.inverse(mean), np.linalg.cholesky(np.asarray(cov))) for mean, cov in pairs]


def _whitened(X: Array, factors: Factors, jacobian_order: int | str) -> tuple[Array, Array]:
    """L_k^-1 J(xi_k)^-1 stacked (12, 6), and L_k^-1 xi_k stacked (12,), where xi_k = log(X X_k^-1)."""
    rows, residuals = [], []
    for inverse_mean, L in factors:
        xi = plain.log(X @ inverse_mean)
        rows.append(np.linalg.solve(L, _inverse_jacobian(xi, jacobian_order)))
        residuals.append(np.linalg.solve(L, xi))
    return np.concatenate(rows), np.concatenate(residuals)


def _inverse_jacobian(xi: Array, order: int | str) -> Array:
    if order == EXACT:
        return plain.inverse_left_jacobian(xi)
    return plain.inverse_left_jacobian_series(xi, int(order))


def _cost(X: Array, factors: Factors) -> float:
    _, residual = _whitened(X, factors, EXACT)
    return float(residual @ residual)


def _gauss_newton(X: Array, factors: Factors, jacobian_order: int | str) -> tuple[Array, Array, float]:
    """Lower factor of the covariance (A^T A)^-1, the step in its terms, and the cost: mu = factor @ descent.

    The columns in reverse order make the triangle of A = Q N a lower one; its inverse is the factor.
    """
    A, residual = _whitened(X, factors, jacobian_order)
    Q, triangle = np.linalg.qr(A[:, ::-1])
    sign = np.sign(np.diag(triangle))
    N = (sign[:, None] * triangle)[::-1, ::-1]
    descent = -((Q * sign).T @ residual)[::-1]
    return np.tril(np.linalg.inv(N)), descent, float(residual @ residual)


def _gradient(X: Array, factors: Factors) -> Array:
    """Of half the cost, over motions of X."""
    A, residual = _whitened(X, factors, EXACT)
    return A.T @ residual


def _newton(X: Array, factor: Array, descent: Array, factors: Factors) -> Array:
    """Newton's step in terms of the factor; the Gauss-Newton step where the Hessian is not positive definite.

    The second derivatives are differences of gradients; in C they are in closed form.
    """
    hessian = np.empty((6, 6))
    for k in range(6):
        there, back = (_gradient(plain.exp(s * DIFFERENCE * factor[:, k]) @ X, factors) for s in (1.0, -1.0))
        hessian[k] = factor.T @ (there - back) / (2.0 * DIFFERENCE)
    try:
        L = np.linalg.cholesky(0.5 * (hessian + hessian.T))
    except np.linalg.LinAlgError:
        return descent
    return np.linalg.solve(L.T, np.linalg.solve(L, descent))


def _line_search(
    X: Array, factor: Array, direction: Array, descent: Array, cost: float, factors: Factors
) -> Array | None:
    """The pose after the longest of the steps 1, 1/2, 1/4, ... that lowers the cost enough, or None."""
    slope = float(descent @ direction)
    if slope <= SEARCH_FROM**2:
        return plain.exp(factor @ direction) @ X
    fraction = 1.0
    while fraction >= SHORTEST_STEP:
        moved = plain.exp(fraction * (factor @ direction)) @ X
        if _cost(moved, factors) <= cost * (1.0 + SLACK) - 2.0 * ARMIJO * fraction * slope:
            return moved
        fraction *= 0.5
    return None


def _versine(a: Array, b: Array) -> float:
    """1 - cos of the angle between two poses."""
    return 0.5 * (3.0 - float(np.sum(a[:3, :3] * b[:3, :3])))


def _result(X: Array, factor: Array, iterations: int, status: FusionStatus, step: float) -> FusionResult:
    """The covariance from its factor, and the mean with rounding taken out of its rotation."""
    return FusionResult(se3.orthonormalized(X), factor @ factor.T, factor, iterations, status, step)
