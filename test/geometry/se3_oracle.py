"""SE(3) from its definitions in 60 digits: power series of matrices, nothing in closed form."""

import mpmath as mp
import numpy as np

from tactile_geometry import se3

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
    return orthonormal(matrix(T))


def closed_log(T):
    """Logarithm in closed form, many times faster than `log`; good up to a half turn less 1e-15."""
    R, t = T[:3, :3], T[:3, 3]
    half = [(R[2, 1] - R[1, 2]) / 2, (R[0, 2] - R[2, 0]) / 2, (R[1, 0] - R[0, 1]) / 2]
    sine = mp.sqrt(sum(x * x for x in half))
    angle = mp.atan2(sine, (R[0, 0] + R[1, 1] + R[2, 2] - 1) / 2)
    phi = [x * angle / sine if sine else mp.mpf(0) for x in half]
    P = skew(phi)
    if angle < mp.mpf(10) ** -15:
        e = mp.mpf(1) / 12 + angle**2 / 720
    else:
        e = (1 - angle / 2 * mp.cot(angle / 2)) / angle**2
    return mp.matrix([*(t - P * t / 2 + e * P * (P * t)), *phi])


def closed_exp(xi):
    """Exp in closed form; for the smallest angles the power series."""
    angle = mp.sqrt(sum(mp.mpf(x) ** 2 for x in list(xi)[3:]))
    if angle < mp.mpf(10) ** -6:
        return exp(xi)
    H = hat(xi)
    return (
        mp.eye(4)
        + H
        + (1 - mp.cos(angle)) / angle**2 * H * H
        + (angle - mp.sin(angle)) / angle**3 * H * H * H
    )


def closed_inverse_jacobian(xi):
    """Inverse left Jacobian as a polynomial of the curly hat; for the smallest angles its series."""
    ad, angle = curly_hat(xi), mp.sqrt(sum(mp.mpf(x) ** 2 for x in list(xi)[3:]))
    square = ad * ad
    if angle < mp.mpf(10) ** -8:
        return mp.eye(6) - ad / 2 + square / 12 - square * square / 720 + square**3 / 30240
    c = angle / 2 * mp.cot(angle / 2)
    e = (1 - c) / angle**2
    d = (1 - c / 2 - angle**2 / (8 * mp.sin(angle / 2) ** 2)) / angle**4
    return mp.eye(6) - ad / 2 + (e + angle**2 * d) * square + d * square * square


def orthonormal(m):
    """The pose m with the nearest rotation, to 60 digits."""
    m = m.copy()
    R = m[:3, :3]
    for _ in range(6):
        R = R * (3 * mp.eye(3) - R.T * R) / 2
    m[:3, :3] = R
    return m


def mahalanobis_cost(X, means, weights):
    """What the fusion minimizes: the sum of the two squared Mahalanobis distances."""
    distances = [closed_log(X * mean**-1) for mean in means]
    return sum((xi.T * weight * xi)[0] for xi, weight in zip(distances, weights, strict=True))


def minimum(means, covs, start):
    """The stationary point of the cost next to `start`, and its information; all in 60 digits."""
    inverses, weights = [mean**-1 for mean in means], [cov**-1 for cov in covs]
    X = start
    for _ in range(400):
        information, gradient = mp.zeros(6, 6), mp.zeros(6, 1)
        for inverse, weight in zip(inverses, weights, strict=True):
            xi = closed_log(X * inverse)
            J = closed_inverse_jacobian(list(xi))
            information += J.T * weight * J
            gradient += J.T * weight * xi
        step = -mp.lu_solve(information, gradient)
        X = closed_exp(list(step)) * X
        if (step.T * information * step)[0] < mp.mpf(10) ** -54:
            return X, information
    raise ArithmeticError("no convergence")


def sigmas_between(X, other, information):
    """Distance of two poses in standard deviations of the second."""
    xi = closed_log(X * other**-1)
    return float(mp.sqrt(abs((xi.T * information * xi)[0])))


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
