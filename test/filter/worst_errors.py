"""Worst errors of exp, log and the Jacobians against 60 digits over all angles.

Also printed by bench/fusion/accuracy.py.
"""

import math
from typing import NamedTuple

import mpmath as mp
import numpy as np
import se3_oracle as oracle

EPS = 2.0**-53  # half a unit in the last place of 1

# From nothing over all orders of magnitude to both sides of a half turn.
ANGLES = [0.0, 1e-300, 1e-160, 1e-20, 1e-12, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 0.01, 0.1, 0.3]
ANGLES += [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.1]
ANGLES += [math.pi - gap for gap in (1e-2, 1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)]
NEAR_PI = math.pi - 1e-2
BEYOND_PI = [math.pi + gap for gap in (1e-13, 1e-9, 1e-7, 1e-3)] + [3.5, 4.0, 4.5, 5.0, 5.5, 6.0, 6.2, 6.28]
BEYOND_PI += [2 * math.pi - 1e-5, 2 * math.pi - 1e-8]


class Worst(NamedTuple):
    """The largest of the errors, in what they are compared with, at the angle where it occurs."""

    error: float
    angle: float


def tangents(angle, count):
    """Tangent vectors of this angle: axes general and along coordinates, lengths of 1e-3 to 1e3."""
    rng = np.random.default_rng([count, int(angle * 1e6)])
    for n in range(count):
        axis = [rng.normal(size=3), np.eye(3)[n % 3], np.eye(3)[n % 3] + 1e-7 * rng.normal(size=3)][n % 3]
        rho = rng.normal(size=3) * 10.0 ** (n % 7 - 3)
        yield np.concatenate((rho, angle * axis / np.linalg.norm(axis)))


def norm(values):
    return mp.sqrt(sum(mp.mpf(v) ** 2 for v in values))


def exp_errors(se3, xi, angle):
    """Of the rotation relative to max(1, angle); of the translation relative to the length of rho."""
    T, reference = se3.exp(xi), oracle.exp(xi)
    rotation = oracle.worst(reference[:3, :3], T[:3, :3]) / max(1.0, angle)
    translation = norm(reference[i, 3] - mp.mpf(T[i, 3]) for i in range(3)) / norm(xi[:3])
    return {"exp, rotation": rotation, "exp, translation": float(translation)}


def log_errors(se3, xi, angle):
    """Of phi relative to its length, of rho to the translation: of the rounded matrix, against xi itself."""
    T = oracle.exp(xi)
    found = se3.log(oracle.as_double(T))
    phi = norm(mp.mpf(found[i]) - mp.mpf(xi[i]) for i in (3, 4, 5)) / (norm(xi[3:]) or 1)
    rho = norm(mp.mpf(found[i]) - mp.mpf(xi[i]) for i in (0, 1, 2)) / norm(T[i, 3] for i in range(3))
    name = "log, phi" if angle < NEAR_PI else "log, phi near pi"
    return {name: float(phi), "log, rho": float(rho)}


def jacobian_errors(se3, xi, angle):
    """Relative to the largest element; of the inverse also divided by its condition where that is large."""
    J = oracle.left_jacobian(xi)
    inverse = J**-1
    condition = float(mp.mnorm(J, "f") * mp.mnorm(inverse, "f"))
    error = oracle.worst(inverse, se3.inverse_left_jacobian(xi)) / oracle.largest(inverse)
    return {
        "left Jacobian": oracle.worst(J, se3.left_jacobian(xi)) / oracle.largest(J),
        "inverse Jacobian, of 1 or condition/8": error / max(1.0, condition / 8.0),
    }


# What holds, in the units of the errors above.
TOLERANCES = {
    "exp, rotation": 4e-16,
    "exp, translation": 4e-16,
    "log, phi": 4e-16,
    "log, phi near pi": 8e-16,
    "log, rho": 8e-16,
    "left Jacobian": 4e-16,
    "inverse Jacobian, of 1 or condition/8": 8e-16,
}


def worst_errors(se3, count):
    """The worst of every error over all angles, `count` tangent vectors at each."""
    worst = {name: Worst(0.0, 0.0) for name in TOLERANCES}
    for angle in ANGLES + BEYOND_PI:
        kinds = (exp_errors, jacobian_errors) + ((log_errors,) if angle <= math.pi else ())
        for xi in tangents(angle, count):
            for kind in kinds:
                for name, error in kind(se3, xi, angle).items():
                    worst[name] = max(worst[name], Worst(error, angle))
    return worst


def table(worst):
    """Text of a table with what was found beside what must hold."""
    lines = [f"{'error':40}{'worst':>10}{'at angle':>24}{'must hold':>12}"]
    for name, (error, angle) in worst.items():
        lines.append(f"{name:40}{error:10.2e}{angle:24.17g}{TOLERANCES[name]:12.0e}")
    return "\n".join(lines)
