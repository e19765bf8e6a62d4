"""SE(3) from its definitions in 60 digits: power series of matrices, nothing in closed form."""

import mpmath as mp
import numpy as np

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
    return max(
        float(abs(m[i, j] - mp.mpf(float(array[i, j])))) for i in range(m.rows) for j in range(m.cols)
    )


def largest(m):
    return max(float(abs(m[i, j])) for i in range(m.rows) for j in range(m.cols))
