"""SE(3): exponential and logarithm, adjoint, left Jacobian and its inverse, interpolation, conversions.

A pose is a homogeneous matrix ``T`` (4, 4), a tangent vector ``xi = [rho, phi]`` (6,) with the translation
first and the rotation in radians (the paper's "Notation and mathematical preliminaries", after Barfoot).
Nothing here knows units of length.

Every coefficient is evaluated by a form in which nothing cancels, so that all functions hold their accuracy
from angle 0 to pi (the Jacobians to 2 pi):

- the curly hat of [rho, phi] acts like the hat of the dual number phi + eps rho, so the upper right block of
  a function of it is the derivative of the 3x3 function at phi along rho;
- ``(theta - sin theta) / theta^3`` and derivatives are power series below pi and closed forms above it, where
  their terms no longer cancel;
- ``e = (1 - (theta/2) cot(theta/2)) / theta^2 = sum over n of 2 / ((2 pi n)^2 - theta^2)``, of which the
  poles n = 1, 2 are added as they stand and the rest as a power series: all terms are positive.

Raises
------
ValueError
    From every function: an argument of the wrong shape or with an element that is not finite.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Vector = Sequence[float]

ROTATION_TOLERANCE = 1e-6  # largest element of R^T R - I for R to count as a rotation

_PI_SQUARED = math.pi**2
_TWO_PI = 2.0 * math.pi
_TWO_PI_LOW = 2.4492935982947064e-16  # 2 pi minus its double
_IDENTITY = np.eye(3)

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


def hat(xi: ArrayLike) -> Array:
    """Matrix (4, 4) of a tangent vector (6,), or (3, 3) of a rotation vector (3,): the paper's wedge."""
    v = np.asarray(xi, dtype=np.float64)
    if v.shape == (3,):
        return _skew(_checked(v, (3,), "phi").tolist())
    x = _checked(v, (6,), "xi")
    result = np.zeros((4, 4))
    result[:3, :3] = _skew(x[3:].tolist())
    result[:3, 3] = x[:3]
    return result


def vee(matrix: ArrayLike) -> Array:
    """The vector of which `matrix` is the hat: (6,) of (4, 4), (3,) of (3, 3); the inverse of `hat`."""
    m = np.asarray(matrix, dtype=np.float64)
    if m.shape == (3, 3):
        _checked(m, (3, 3), "matrix")
        return 0.5 * np.array((m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]))
    _checked(m, (4, 4), "matrix")
    return np.concatenate((m[:3, 3], vee(m[:3, :3])))


def curly_hat(xi: ArrayLike) -> Array:
    """The algebra's adjoint ad(xi) (6, 6) = [[phi^, rho^], [0, phi^]] (paper's curly hat)."""
    v = _checked(xi, (6,), "xi").tolist()
    return _upper_block(_skew(v[3:]), _skew(v[:3]))


def exp(xi: ArrayLike) -> Array:
    """Pose (4, 4) = exp(xi^) of a tangent vector (6,), in closed form (paper's exponential map)."""
    values = _checked(xi, (6,), "xi").tolist()
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
    pose = _checked_pose(T)
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
    pose = _checked_pose(T)
    result = np.empty((4, 4))
    result[:3, :3] = pose[:3, :3].T
    result[:3, 3] = -(pose[:3, 3] @ pose[:3, :3])
    result[3] = 0.0, 0.0, 0.0, 1.0
    return result


def adjoint(T: ArrayLike) -> Array:
    """Ad(T) (6, 6) = [[C, r^ C], [0, C]], so that exp((Ad(T) xi)^) = T exp(xi^) T^-1 (paper's adjoint)."""
    pose = _checked_pose(T)
    C = pose[:3, :3]
    return _upper_block(C, _skew(pose[:3, 3].tolist()) @ C)


def left_jacobian(xi: ArrayLike) -> Array:
    """Left Jacobian J (6, 6): exp((xi + d)^) = exp((J d)^) exp(xi^) to first order in d. Closed form."""
    values = _checked(xi, (6,), "xi").tolist()
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
    values = _checked(xi, (6,), "xi").tolist()
    rho, phi = values[:3], values[3:]
    e, de = _inverse_coefficients(math.hypot(*phi))
    return _dual_polynomial(phi, rho, (-0.5, e), (0.0, de))


def inverse_left_jacobian_series(xi: ArrayLike, order: int) -> Array:
    """The series of the inverse left Jacobian (6, 6) up to `order` (2 or 4); the paper takes order 2."""
    values = _checked(xi, (6,), "xi").tolist()
    rho, phi = values[:3], values[3:]
    if order == 2:
        e, de = 1.0 / 12.0, 0.0
    elif order == 4:
        e, de = 1.0 / 12.0 + sum(p * p for p in phi) / 720.0, 1.0 / 360.0
    else:
        raise ValueError(f"order = {order!r}: must be 2 or 4")
    return _dual_polynomial(phi, rho, (-0.5, e), (0.0, de))


def interpolate(T0: ArrayLike, T1: ArrayLike, s: float) -> Array:
    """Pose (4, 4) at the fraction s of the screw motion from T0 to T1; exactly T0 at 0 and T1 at 1."""
    start, end = _checked_pose(T0), _checked_pose(T1)
    if not math.isfinite(s):
        raise ValueError(f"s = {s}: must be finite")
    if s == 0.0:
        return start.copy()
    if s == 1.0:
        return end.copy()
    R = start[:3, :3]
    between = np.eye(4)
    between[:3, :3] = R.T @ end[:3, :3]
    between[:3, 3] = (end[:3, 3] - start[:3, 3]) @ R
    return start @ exp(s * log(between))


def orthonormalized(T: ArrayLike) -> Array:
    """The pose (4, 4) with its rotation replaced by the nearest one (to rounding).

    Raises
    ------
    ValueError
        If the upper left block is further than `ROTATION_TOLERANCE` from a rotation.
    """
    pose = _checked_pose(T).copy()
    R = pose[:3, :3]
    excess = _checked_rotation(R, "T")
    # R (I + excess)^(-1/2); the next term of the series is below rounding
    pose[:3, :3] = R - R @ (0.5 * excess - 0.375 * (excess @ excess))
    return pose


def _checked_rotation(R: Array, name: str) -> Array:
    """R^T R - I of R (3, 3); ValueError if R is no rotation within `ROTATION_TOLERANCE`."""
    excess = R.T @ R - _IDENTITY
    error = float(np.abs(excess).max())
    if not error <= ROTATION_TOLERANCE:
        raise ValueError(f"{name}: its rotation is not orthonormal, R^T R is off the identity by {error:.3g}")
    first, second, third = R.tolist()
    if sum(a * b for a, b in zip(_cross(first, second), third, strict=True)) < 0.0:
        raise ValueError(f"{name}: its rotation is a reflection, det R = -1")
    return excess


def pose_from_euler(pose6: ArrayLike) -> Array:
    """Pose (4, 4) of (x, y, z, alpha, beta, gamma): turns (rad) about the fixed axes x, y, z in turn.

    This is 'sxyz' of transforms3d and 'xyz' of SciPy: R = Rz(gamma) Ry(beta) Rx(alpha).
    """
    x, y, z, alpha, beta, gamma = _checked(pose6, (6,), "pose6").tolist()
    ca, sa = math.cos(alpha), math.sin(alpha)
    cb, sb = math.cos(beta), math.sin(beta)
    cg, sg = math.cos(gamma), math.sin(gamma)
    return np.array(
        (
            (cg * cb, cg * sb * sa - sg * ca, cg * sb * ca + sg * sa, x),
            (sg * cb, sg * sb * sa + cg * ca, sg * sb * ca - cg * sa, y),
            (-sb, cb * sa, cb * ca, z),
            (0.0, 0.0, 0.0, 1.0),
        )
    )


def euler_from_pose(T: ArrayLike) -> Array:
    """(x, y, z, alpha, beta, gamma) (6,) of a pose (4, 4), |beta| <= pi/2; the inverse of `pose_from_euler`.

    At |beta| = pi/2, where only alpha and gamma together are defined, gamma is 0.
    """
    pose = _checked_pose(T)
    (r00, _, _, x), (r10, r11, r12, y), (r20, r21, r22, z), _ = pose.tolist()
    cos_beta = math.hypot(r00, r10)
    beta = math.atan2(-r20, cos_beta)
    if cos_beta > 4.0 * np.finfo(np.float64).eps:
        return np.array((x, y, z, math.atan2(r21, r22), beta, math.atan2(r10, r00)))
    return np.array((x, y, z, math.atan2(-r12, r11), beta, 0.0))


def quaternion_from_rotation(R: ArrayLike) -> Array:
    """Unit quaternion (4,) as (x, y, z, w) of a rotation (3, 3), w >= 0 (Shepperd's method).

    At w = 0 the first non-zero component is positive.
    """
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = _checked(R, (3, 3), "R").tolist()
    trace = r00 + r11 + r22
    largest = max(trace, r00, r11, r22)
    if largest == trace:
        q = (r21 - r12, r02 - r20, r10 - r01, 1.0 + trace)
    elif largest == r00:
        q = (1.0 + r00 - r11 - r22, r01 + r10, r02 + r20, r21 - r12)
    elif largest == r11:
        q = (r01 + r10, 1.0 - r00 + r11 - r22, r12 + r21, r02 - r20)
    else:
        q = (r02 + r20, r12 + r21, 1.0 - r00 - r11 + r22, r10 - r01)
    norm = math.hypot(*q)
    if norm == 0.0:
        raise ValueError("R: is not a rotation")
    leading = q[3] or next(component for component in q if component)
    return np.array(q) * math.copysign(1.0 / norm, leading) + 0.0


def rotation_from_quaternion(quaternion: ArrayLike) -> Array:
    """Rotation (3, 3) of a quaternion (x, y, z, w) of any non-zero norm."""
    x, y, z, w = _checked(quaternion, (4,), "quaternion").tolist()
    norm = math.hypot(x, y, z, w)
    if norm == 0.0:
        raise ValueError("quaternion: is zero, must have norm 1")
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return np.array(
        (
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
            (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
            (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
        )
    )


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


def _checked(value: ArrayLike, shape: tuple[int, ...], name: str) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name}: must have shape {shape}, has {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: must be finite, is {array.tolist()}")
    return array


def _checked_pose(T: ArrayLike) -> Array:
    pose = _checked(T, (4, 4), "T")
    if pose[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise ValueError(f"T: last row must be [0, 0, 0, 1], is {pose[3].tolist()}")
    return pose
