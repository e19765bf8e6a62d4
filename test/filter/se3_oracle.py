"""SE(3) from its definitions in 60 digits: power series of matrices, nothing in closed form."""

import mpmath as mp
import numpy as np

from tactile_filter import se3

mp.mp.dps = 60


def matrix(array):
    """The exact value of a double array as an mpmath matrix."""
    return mp.matrix([[mp.mpf(float(v)) for v in row] for row in np.atleast_2d(array)])


def as_double(m):
    return np.array([[float(m[i, j]) for j in range(m.cols)] for i in range(m.rows)])


def skew(v):
    return mp.matrix([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def hat(xi):
    v = [mp.mpf(x) for x in xi]
    m = mp.zeros(4, 4)
    m[:3, :3] = skew(v[3:])
    for i in range(3):
        m[i, 3] = v[i]
    return m


def curly_hat(xi):
    v = [mp.mpf(x) for x in xi]
    m = mp.zeros(6, 6)
    m[:3, :3] = m[3:, 3:] = skew(v[3:])
    m[:3, 3:] = skew(v[:3])
    return m


def power_series(m, first):
    """Sum of m**n / (n + first)! over n >= 0."""
    term = mp.eye(m.rows) / mp.factorial(first)
    total, n = term.copy(), 0
    while mp.mnorm(term, 1) > mp.mpf(10) ** -58 or n < 5:
        n += 1
        term = term * m / (n + first)
        total += term
    return total


def exp(xi):
    return power_series(hat(xi), 0)


def left_jacobian(xi):
    return power_series(curly_hat(xi), 1)


def inverse_left_jacobian(xi):
    return left_jacobian(xi) ** -1


def worst(m, array):
    """Largest difference of elements between an mpmath matrix and a double array, rounded only at the end."""
    return max(float(abs(m[i, j] - mp.mpf(float(array[i, j])))) for i in range(m.rows) for j in range(m.cols))


def largest(m):
    return max(float(abs(m[i, j])) for i in range(m.rows) for j in range(m.cols))


def log(T):
    """Logarithm by Newton's method on the definition, from a double start."""
    xi = mp.matrix([mp.mpf(float(v)) for v in se3.log(nearest_rotation(as_double(T)))])
    for _ in range(8):
        error = T * exp(list(-xi)) - mp.eye(4)
        vector = mp.matrix([error[0, 3], error[1, 3], error[2, 3], error[2, 1], error[0, 2], error[1, 0]])
        xi += inverse_left_jacobian(list(xi)) * vector
        if mp.norm(vector) < mp.mpf(10) ** -45:
            return xi
    raise ArithmeticError("no convergence")


def nearest_rotation(T):
    u, _, vt = np.linalg.svd(T[:3, :3])
    result = T.copy()
    result[:3, :3] = u @ vt
    return result


def exact_rotation(T):
    """A pose in 60 digits whose rotation is one to 60 digits, next to the double pose T."""
    m = matrix(T)
    R = m[:3, :3]
    for _ in range(6):
        R = R * (3 * mp.eye(3) - R.T * R) / 2
    m[:3, :3] = R
    return m


def fuse(mean_1, cov_1, mean_2, cov_2, iterations=None):
    """The algorithm as the paper writes it: with `iterations` and order 2, or exactly to convergence.

    Returns the mean, the covariance before the last update, and the last step.
    """
    means = [exact_rotation(mean_1), exact_rotation(mean_2)]
    weights = [matrix(cov_1) ** -1, matrix(cov_2) ** -1]
    X = means[0].copy()
    for count in range(1, 200):
        information, gradient = mp.zeros(6, 6), mp.zeros(6, 1)
        for mean, weight in zip(means, weights, strict=True):
            xi = log(X * mean**-1)
            ad = curly_hat(list(xi))
            J = inverse_left_jacobian(list(xi)) if iterations is None else mp.eye(6) - ad / 2 + ad * ad / 12
            information += J.T * weight * J
            gradient += J.T * weight * xi
        cov = information**-1
        step = -cov * gradient
        X = exp(list(step)) * X
        if count == iterations or (iterations is None and mp.norm(step) < mp.mpf(10) ** -30):
            return X, cov, step
    raise ArithmeticError("no convergence")
