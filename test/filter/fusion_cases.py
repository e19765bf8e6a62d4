"""Pairs of Gaussians at the extremes, and what mode "exact" makes of them against 60 digits."""

import mpmath as mp
import numpy as np
import se3_oracle as oracle
from contact_case import SIGMA

from tactile_geometry import se3

UNIT = np.ones(6)


def symmetric(matrix):
    return 0.5 * (matrix + matrix.T)


def correlated(rng, sigma, correlation=0.7):
    """Covariance with these standard deviations."""
    factor = np.eye(6) + correlation * np.tril(rng.uniform(-1, 1, (6, 6)), -1)
    cov = factor @ factor.T
    scale = sigma / np.sqrt(np.diag(cov))
    return symmetric(cov * np.outer(scale, scale))


def rotated(rng, decades):
    """Covariance with eigenvalues over so many decades in directions that mix units."""
    Q = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    return symmetric((Q * 10.0 ** np.linspace(-decades, 0, 6)) @ Q.T)


def seen_from(shift, cov):
    """The covariance in a frame shifted by a lever arm (3,)."""
    adjoint = se3.adjoint(se3.exp(np.concatenate((shift, np.zeros(3)))))
    return symmetric(adjoint @ cov @ adjoint.T)


def random_mean(rng):
    return se3.exp(np.concatenate((0.3 * rng.normal(size=3), rng.normal(size=3))))


def turned(rng, degrees, shift=0.3):
    axis = rng.normal(size=3)
    return se3.exp(
        np.concatenate((shift * rng.normal(size=3), np.radians(degrees) * axis / np.linalg.norm(axis)))
    )


def random_pair(seed, separation=2.0):
    """Two Gaussians around the same truth, `separation` standard deviations of an estimate apart."""
    rng = np.random.default_rng(seed)
    mean_1 = se3.exp(np.concatenate((0.02 * rng.normal(size=3), 0.4 * rng.normal(size=3))))
    mean_2 = se3.exp(separation * SIGMA * rng.normal(size=6)) @ mean_1
    covs = [correlated(rng, SIGMA * 10.0 ** rng.uniform(-0.5, 0.5, 6), 0.8) for _ in range(2)]
    return mean_1, covs[0], mean_2, covs[1]


def in_sigmas(a, b, cov):
    """Distance of two poses in standard deviations."""
    return float(np.linalg.norm(np.linalg.solve(np.linalg.cholesky(cov), se3.log(a @ se3.inverse(b)))))


def cases(seed):
    """Name -> (mean_1, cov_1, mean_2, cov_2)."""
    rng = np.random.default_rng(seed)
    X = random_mean(rng)

    def near(scale):
        return se3.exp(scale * rng.normal(size=6)) @ X

    def contact():
        return correlated(rng, SIGMA)

    grades = 10.0 ** rng.uniform(-6, 6, 6)
    lever = 0.3 * rng.normal(size=3)
    sharp, soft = np.array([2e-4, 1e-3, 5e-3, 0.05, 0.2, 0.5]), np.array([2e-3, 1e-4, 5e-3, 0.5, 0.2, 0.05])
    found = {
        "contact": (X, contact(), near(3 * SIGMA), contact()),
        "unit": (X, correlated(rng, UNIT), near(0.7), correlated(rng, UNIT)),
        "tiny": (X, 1e-12 * np.eye(6), near(1e-6), 1e-12 * correlated(rng, UNIT)),
        "huge": (X, 1e12 * np.eye(6), near(0.3), 1e12 * correlated(rng, UNIT)),
        "ratio 1e18": (X, 1e-9 * contact(), near(1e-7), 1e9 * contact()),
        "ratio 1e-18": (X, 1e9 * contact(), near(1e-7), 1e-9 * contact()),
        "graded": (X, correlated(rng, grades), near(1e-6), correlated(rng, grades[::-1])),
        "rotated 1e8": (X, rotated(rng, 8), near(1e-4), rotated(rng, 8)),
        "rotated 1e14": (X, rotated(rng, 14), near(1e-7), rotated(rng, 8)),
        "lever": (
            X, seen_from(lever, correlated(rng, sharp)), near(np.repeat([0.01, 0.3], 3)),
            seen_from(lever, correlated(rng, soft)),
        ),
        "lever apart": (X, np.diag(sharp**2), turned(rng, 40) @ X, np.diag(soft**2)),
    }  # fmt: skip
    for degrees in (60, 120, 170, 179):
        covs = [0.25 * correlated(rng, UNIT) for _ in range(2)]
        found[f"{degrees} degrees"] = (X, covs[0], turned(rng, degrees) @ X, covs[1])
    return found


def as_exact(pair):
    """Means and covariances in 60 digits; the means with the nearest rotation."""
    means = [oracle.exact_rotation(mean) for mean in pair[::2]]
    return means, [oracle.matrix(cov) for cov in pair[1::2]]


def rounded_otherwise(pair, rng):
    """The same with every element half a unit in the last place off, to either side."""

    def off():
        return 1 + mp.mpf(2) ** -53 * int(rng.choice([-1, 1]))

    means, covs = [oracle.matrix(mean) for mean in pair[::2]], [oracle.matrix(cov) for cov in pair[1::2]]
    for mean in means:
        for i in range(3):
            for j in range(4):
                mean[i, j] *= off()
    for cov in covs:
        for i in range(6):
            for j in range(i + 1):
                cov[i, j] = cov[j, i] = cov[i, j] * off()
    return [oracle.orthonormal(mean) for mean in means], covs


def exact_error(pair, fused, draws=2):
    """Error of the mean in standard deviations, what rounding the inputs alone costs, and the minimum."""
    X, information = oracle.minimum(*as_exact(pair), oracle.exact_rotation(fused.mean))
    error = oracle.sigmas_between(oracle.exact_rotation(fused.mean), X, information)
    rng, cost = np.random.default_rng(1), 0.0
    for _ in range(draws):
        moved, _ = oracle.minimum(*rounded_otherwise(pair, rng), X)
        cost = max(cost, oracle.sigmas_between(moved, X, information))
    return error, cost, X, information


def tolerance(rounding_cost):
    """What the error of mode "exact" has to be within, in standard deviations."""
    return 4e-15 + 32.0 * rounding_cost


def extreme_covariance(rng) -> np.ndarray:
    """One of the covariances, and of the matrices that are none, at the ends of what a double holds."""
    sizes, A = 10.0 ** rng.uniform(-320, 308, 6), rng.standard_normal((6, 6))
    spoilt = np.eye(6)
    spoilt[tuple(rng.integers(6, size=2))] = rng.choice([np.nan, np.inf, 1e308, -1e308, 0.0, 1e-320])
    kinds = [
        np.diag(sizes),
        A @ A.T * 10.0 ** rng.uniform(-300, 300),
        A * 10.0 ** rng.uniform(-300, 307),
        1.7e308 * rng.choice([-1.0, 1.0], (6, 6)),
        np.sqrt(np.outer(sizes, sizes)) * (A @ A.T),
        spoilt,
    ]
    return kinds[rng.integers(len(kinds))]


def extreme_mean(rng) -> np.ndarray:
    """The same of a pose."""
    X = se3.exp(0.5 * rng.standard_normal(6))
    kind = rng.integers(4)
    if kind == 1:
        X[:3, 3] *= 10.0 ** rng.uniform(-300, 300)
    elif kind == 2:
        X[:3, 3] = 1.7e308 * rng.choice([-1.0, 1.0], 3)
    elif kind == 3:
        X[tuple(rng.integers(4, size=2))] = rng.choice([np.nan, np.inf, 1e308, 1e200])
    return X
