"""exp, log, adjoint, left Jacobian and inverse in plain NumPy, to be read; `tactile_geometry.se3` is in C.

The C functions work with twice the precision and round once; these are as good as doubles allow by forms in
which nothing cancels, so that they hold their accuracy from angle 0 to pi (the Jacobians to 2 pi):

- the curly hat of [rho, phi] acts like the hat of the dual number phi + eps rho, so the upper right block of
  a function of it is the derivative of the 3x3 function at phi along rho;
- ``(theta - sin theta) / theta^3`` and derivatives are power series below pi and closed forms above it, where
  their terms no longer cancel;
- ``e = (1 - (theta/2) cot(theta/2)) / theta^2 = sum over n of 2 / ((2 pi n)^2 - theta^2)``, of which the
  poles n = 1, 2 are added as they stand and the rest as a power series: all terms are positive.

Arguments are not checked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_geometry.se3 import quaternion_from_rotation

Array = NDArray[np.float64]
Vector = Sequence[float]

_PI_SQUARED = math.pi**2
_TWO_PI = 2.0 * math.pi
_TWO_PI_LOW = 2.4492935982947064e-16  # 2 pi minus its double

# (theta - sin theta) / theta^3 = sum (-1)^n theta^(2n) / (2n + 3)!, and 2 d/d(theta^2) of it and of
# (1 - cos theta) / theta^2 = sum (-1)^n theta^(2n) / (2n + 2)!
_C_SERIES = tuple((-1) ** n / math.factorial(2 * n + 3) for n in range(15))
_DC_SERIES = tuple((-1) ** n * 2 * n / math.factorial(2 * n + 3) for n in range(1, 16))
_DB_SERIES = tuple((-1) ** n * 2 * n / math.factorial(2 * n + 2) for n in range(1, 16))


def _zeta_tail(power: int) -> float:
    """Sum of n**-power over n >= 3, from n = 40 on by the formula of Euler and Maclaurin."""
    last = 40.0
    rest = last ** (1 - power) / (power - 1) + 0.5 * last**-power
    for k, bernoulli in ((1, 1.0 / 6.0), (2, -1.0 / 30.0), (3, 1.0 / 42.0), (4, -1.0 / 30.0)):
        rising = math.prod(range(power, power + 2 * k - 1))
        rest += bernoulli / math.factorial(2 * k) * rising * last ** (1 - power - 2 * k)
    return math.fsum([rest, *(float(n) ** -power for n in range(3, 40))])


# What the poles from n = 3 on add to e, as a power series in theta^2; then twice its derivative.
_E_SERIES = tuple(2.0 * _zeta_tail(2 * k + 2) / _TWO_PI ** (2 * k + 2) for k in range(19))
_DE_SERIES = tuple(2.0 * k * _E_SERIES[k] for k in range(1, 19))


def exp(xi: ArrayLike) -> Array:
    """Pose (4, 4) = exp(xi^) of a tangent vector (6,), in closed form (paper's exponential map)."""
    values = np.asarray(xi, dtype=np.float64).tolist()
    rho, phi = values[:3], values[3:]
    theta = math.hypot(*phi)
    a, b, c = _exp_coefficients(theta)
    turned = _cross(phi, rho)
    twice = _cross(phi, turned)
    result = np.empty((4, 4))
    result[:3, :3] = _rodrigues(phi, a, b)
    result[:3, 3] = [r + b * u + c * w for r, u, w in zip(rho, turned, twice, strict=True)]
    result[3] = 0.0, 0.0, 0.0, 1.0
    return result


def log(T: ArrayLike) -> Array:
    """Tangent vector (6,) of a pose (4, 4), with |phi| <= pi (paper's logarithmic map).

    At exactly pi, where phi and -phi are the same rotation, the first non-zero component of phi is positive.
    """
    pose = np.asarray(T, dtype=np.float64)
    phi = rotation_vector(pose[:3, :3]).tolist()
    t = pose[:3, 3].tolist()
    e, _ = _inverse_coefficients(math.hypot(*phi))
    turned = _cross(phi, t)
    twice = _cross(phi, turned)
    rho = [p - 0.5 * u + e * w for p, u, w in zip(t, turned, twice, strict=True)]
    return np.array(rho + phi)


def rotation_vector(R: ArrayLike) -> Array:
    """Rotation vector phi (3,) of a rotation (3, 3), |phi| <= pi, through its quaternion."""
    x, y, z, w = quaternion_from_rotation(R).tolist()
    sine = math.hypot(x, y, z)
    scale = 2.0 / w if sine == 0.0 else 2.0 * math.atan2(sine, w) / sine
    return np.array((x * scale, y * scale, z * scale))


def inverse(T: ArrayLike) -> Array:
    """Inverse of a pose (4, 4), from the transpose of its rotation."""
    pose = np.asarray(T, dtype=np.float64)
    result = np.empty((4, 4))
    result[:3, :3] = pose[:3, :3].T
    result[:3, 3] = -(pose[:3, 3] @ pose[:3, :3])
    result[3] = 0.0, 0.0, 0.0, 1.0
    return result


def adjoint(T: ArrayLike) -> Array:
    """Ad(T) (6, 6) = [[C, r^ C], [0, C]], so that exp((Ad(T) xi)^) = T exp(xi^) T^-1 (paper's adjoint)."""
    pose = np.asarray(T, dtype=np.float64)
    C = pose[:3, :3]
    return _upper_block(C, _skew(pose[:3, 3].tolist()) @ C)


def left_jacobian(xi: ArrayLike) -> Array:
    """Left Jacobian J (6, 6): exp((xi + d)^) = exp((J d)^) exp(xi^) to first order in d. Closed form."""
    values = np.asarray(xi, dtype=np.float64).tolist()
    rho, phi = values[:3], values[3:]
    theta = math.hypot(*phi)
    _, b, c = _exp_coefficients(theta)
    db, dc = _jacobian_derivatives(theta)
    return _dual_polynomial(phi, rho, (b, c), (db, dc))


def inverse_left_jacobian(xi: ArrayLike) -> Array:
    """Inverse (6, 6) of the left Jacobian, in closed form; not at |phi| = 2 pi n, n > 0.

    With ad the curly hat of xi it equals I - ad/2 + (e + theta^2 d) ad^2 + d ad^4, where
    e = (1 - (theta/2) cot(theta/2)) / theta^2 and d = -(de/dtheta) / (2 theta).
    """
    values = np.asarray(xi, dtype=np.float64).tolist()
    rho, phi = values[:3], values[3:]
    e, de = _inverse_coefficients(math.hypot(*phi))
    return _dual_polynomial(phi, rho, (-0.5, e), (0.0, de))


def inverse_left_jacobian_series(xi: ArrayLike, order: int) -> Array:
    """The series of the inverse left Jacobian (6, 6) up to `order` (2 or 4); the paper takes order 2."""
    ad = curly_hat(xi)
    squared = ad @ ad
    result = np.eye(6) - 0.5 * ad + squared / 12.0
    return result if order == 2 else result - squared @ squared / 720.0


def hat(xi: ArrayLike) -> Array:
    """Matrix (4, 4) of a tangent vector (6,): the paper's wedge."""
    values = np.asarray(xi, dtype=np.float64).tolist()
    result = np.zeros((4, 4))
    result[:3, :3], result[:3, 3] = _skew(values[3:]), values[:3]
    return result


def curly_hat(xi: ArrayLike) -> Array:
    """The algebra's adjoint ad(xi) (6, 6) = [[phi^, rho^], [0, phi^]] (paper's curly hat)."""
    values = np.asarray(xi, dtype=np.float64).tolist()
    return _upper_block(_skew(values[3:]), _skew(values[:3]))


def _exp_coefficients(theta: float) -> tuple[float, float, float]:
    """sin(theta)/theta, (1 - cos theta)/theta^2, (theta - sin theta)/theta^3."""
    if theta == 0.0:
        return 1.0, 0.5, 1.0 / 6.0
    sine = math.sin(theta)
    half = math.sin(0.5 * theta) / theta
    if theta <= math.pi:
        return sine / theta, 2.0 * half * half, _polynomial(_C_SERIES, theta * theta)
    return sine / theta, 2.0 * half * half, (1.0 - sine / theta) / (theta * theta)


def _jacobian_derivatives(theta: float) -> tuple[float, float]:
    """d/dtheta, over theta, of the last two of `_exp_coefficients`."""
    x = theta * theta
    if theta <= math.pi:
        return _polynomial(_DB_SERIES, x), _polynomial(_DC_SERIES, x)
    sine, cosine = math.sin(theta), math.cos(theta)
    db = (sine / theta - 4.0 * (math.sin(0.5 * theta) / theta) ** 2) / x
    return db, (3.0 * sine / theta - 2.0 - cosine) / (x * x)


def _inverse_coefficients(theta: float) -> tuple[float, float]:
    """The pair e = (1 - (theta/2) cot(theta/2)) / theta^2 and (de/dtheta) / theta."""
    x = theta * theta
    if theta >= _TWO_PI:
        half_sine = math.sin(0.5 * theta)
        c = 0.5 * theta * math.cos(0.5 * theta) / half_sine
        return (1.0 - c) / x, (c - 2.0 + x / (4.0 * half_sine * half_sine)) / (x * x)
    first = 1.0 / (((_TWO_PI - theta) + _TWO_PI_LOW) * (_TWO_PI + theta))
    second = 1.0 / (16.0 * _PI_SQUARED - x)
    e = 2.0 * (first + second) + _polynomial(_E_SERIES, x)
    de = 4.0 * (first * first + second * second) + _polynomial(_DE_SERIES, x)
    return e, de


def _polynomial(coefficients: tuple[float, ...], x: float) -> float:
    result = 0.0
    for coefficient in reversed(coefficients):
        result = result * x + coefficient
    return result


def _dual_polynomial(
    phi: Vector, rho: Vector, coefficients: tuple[float, float], derivatives: tuple[float, float]
) -> Array:
    """I + b ad + c ad^2 in dual numbers; `derivatives` are (db/dtheta) / theta and (dc/dtheta) / theta."""
    (b, c), (db, dc) = coefficients, derivatives
    P, R = _skew(phi), _skew(rho)
    squared = P @ P
    along = sum(p * r for p, r in zip(phi, rho, strict=True))
    product = P @ R
    # R P is the transpose of P R, both being skew
    corner = b * R + c * (product + product.T) + along * (db * P + dc * squared)
    block = b * P + c * squared
    block[np.diag_indices(3)] += 1.0
    return _upper_block(block, corner)


def _rodrigues(phi: Vector, a: float, b: float) -> list[list[float]]:
    """I + a phi^ + b phi^ phi^."""
    x, y, z = phi
    ax, ay, az = a * x, a * y, a * z
    bxy, bxz, byz = b * x * y, b * x * z, b * y * z
    return [
        [1.0 - b * (y * y + z * z), bxy - az, bxz + ay],
        [bxy + az, 1.0 - b * (x * x + z * z), byz - ax],
        [bxz - ay, byz + ax, 1.0 - b * (x * x + y * y)],
    ]


def _skew(v: Vector) -> Array:
    x, y, z = v
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


def _cross(a: Vector, b: Vector) -> list[float]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _upper_block(block: Array, corner: Array) -> Array:
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = block
    result[:3, 3:] = corner
    return result
