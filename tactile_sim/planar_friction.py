"""Friction of a body that slides on a floor: which load moves it which way, by three models.

- `Ellipsoid`: (f_x^2 + f_y^2) / F^2 + m^2 / (F arm)^2 = 1 (Howe and Cutkosky 1996), which simulations have.
- `PointCoulomb`: Coulomb's law at points of support that each carry a part of the load; exact, where one
  knows them. The motion under a load is the one that dissipates least of all on which the load does the
  same work (Goyal, Ruina and Papadopoulos 1991).
- `ConvexPolynomial`: H(load) = 1, homogeneous of degree four, fitted to measured loads and motions, as in
  Zhou, Mason, Paolini and Bagnell (ICRA 2016). Here it is a sum of squares of (load' A load) with A
  positive semidefinite, which is convex, where they have all polynomials whose Hessian is a sum of squares.

Loads are (f_x, f_y, m / length), motions (v_x, v_y, length * turn), about the centre of friction, all with
the same length, so that both have one unit. Arrays are (..., 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]

_SQUARES = 3  # of a polynomial
_SHAPE_WEIGHT = 0.3  # of a load's size against a motion's direction, in a fit: what Zhou et al. trade as eta
_SMOOTH = 1e-6  # of speeds at points of support, where Coulomb's law has a corner
_LOWER = np.tril_indices(3)


class FrictionModel(Protocol):
    """What the models have in common."""

    def motion(self, load: Array) -> Array:
        """Unit vectors (..., 3) along which bodies under these loads slide."""

    def size(self, load: Array) -> Array:
        """The loads (...) as a multiple of those under which the body slides."""


@dataclass(frozen=True)
class Ellipsoid:
    """The total friction, N, and the ratio of the largest torque to it over the loads' length."""

    force: float
    arm: float

    def motion(self, load: Array) -> Array:
        """See `FrictionModel`."""
        return _unit(load / [1.0, 1.0, self.arm**2])

    def size(self, load: Array) -> Array:
        """See `FrictionModel`."""
        return np.asarray(np.linalg.norm(load / [1.0, 1.0, self.arm], axis=-1) / self.force)


@dataclass(frozen=True)
class PointCoulomb:
    """Points of support (n, 2), over the loads' length, and the friction (n,) that each has, N."""

    points: Array
    friction: Array

    def motion(self, load: Array) -> Array:
        """See `FrictionModel`: by Newton's method on a convex function, all loads at once."""
        flat = _unit(load.reshape(-1, 3))
        # motions u on which the load does work 1: the load itself, and two directions that are normal to it
        normal = np.linalg.svd(flat[:, None, :], full_matrices=True)[2][:, 1:]
        jacobian = np.zeros((len(self.points), 2, 3))
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
        jacobian[:, 0, 2], jacobian[:, 1, 2] = -self.points[:, 1], self.points[:, 0]
        z = np.zeros((len(flat), 2))
        smooth = 1.0
        while smooth > _SMOOTH:  # so that no step begins far from where it ends
            smooth = max(_SMOOTH, 0.1 * smooth)
            for _ in range(3):
                z -= self._step(flat + np.einsum("ik,ikj->ij", z, normal), normal, jacobian, smooth)
        return _unit(flat + np.einsum("ik,ikj->ij", z, normal)).reshape(load.shape)

    def _step(self, u: Array, normal: Array, jacobian: Array, smooth: float) -> Array:
        """Newton's step (N, 2) of the dissipation along the normals, halved until it falls."""
        speed = np.einsum("pcj,ij->ipc", jacobian, u)
        size = np.sqrt((speed**2).sum(axis=2) + smooth**2)
        toward = np.einsum("p,ipc,ip,pcj->ij", self.friction, speed, 1.0 / size, jacobian)
        gradient = np.einsum("ikj,ij->ik", normal, toward)
        across = np.eye(2) / size[..., None, None] - np.einsum(
            "ipc,ipd->ipcd", speed, speed / size[..., None] ** 3
        )
        hessian = np.einsum("p,pcj,ipcd,pdk->ijk", self.friction, jacobian, across, jacobian)
        reduced = np.einsum("iaj,ijk,ibk->iab", normal, hessian, normal) + 1e-9 * np.eye(2)
        step = np.linalg.solve(reduced, gradient[..., None])[..., 0]
        before, scale = self.dissipation(u, smooth), np.ones(len(u))
        for _ in range(20):
            moved = u - np.einsum("i,ik,ikj->ij", scale, step, normal)
            worse = self.dissipation(moved, smooth) > before + 1e-12
            if not worse.any():
                break
            scale[worse] *= 0.5
        return scale[:, None] * step

    def dissipation(self, u: Array, smooth: float = 0.0) -> Array:
        """Power (...) of friction under motions, N times their unit."""
        x, y, turn = np.moveaxis(u[..., None, :], -1, 0)
        speed = np.sqrt((x - turn * self.points[:, 1]) ** 2 + (y + turn * self.points[:, 0]) ** 2 + smooth**2)
        return np.asarray(speed @ self.friction)

    def size(self, load: Array) -> Array:
        """See `FrictionModel`."""
        u = self.motion(load)
        return np.asarray((load * u).sum(axis=-1) / self.dissipation(u))


@dataclass(frozen=True)
class ConvexPolynomial:
    """H(load) = sum of (load' A load)^2 over positive semidefinite A (k, 3, 3)."""

    squares: Array

    def value(self, load: Array) -> Array:
        """H (...)."""
        return np.asarray((np.einsum("...i,kij,...j->...k", load, self.squares, load) ** 2).sum(axis=-1))

    def motion(self, load: Array) -> Array:
        """See `FrictionModel`."""
        pulled = np.einsum("kij,...j->...ki", self.squares, load)
        return _unit((np.einsum("...ki,...i->...k", pulled, load)[..., None] * pulled).sum(axis=-2))

    def size(self, load: Array) -> Array:
        """See `FrictionModel`."""
        return np.asarray(self.value(load) ** 0.25)

    @classmethod
    def fit(cls, load: Array, motion: Array, start: Ellipsoid) -> ConvexPolynomial:
        """To loads (N, 3) under which bodies slid, and unit motions (N, 3)."""
        unit = load / np.linalg.norm(load, axis=1).mean()
        ratio = start.force / np.linalg.norm(load, axis=1).mean()

        def of(numbers: Array) -> ConvexPolynomial:
            lower = np.zeros((_SQUARES, 3, 3))
            lower[:, _LOWER[0], _LOWER[1]] = numbers.reshape(_SQUARES, -1)
            return cls(lower @ np.swapaxes(lower, 1, 2))

        def errors(numbers: Array) -> Array:
            model = of(numbers)
            shape = _SHAPE_WEIGHT * np.log(model.value(unit)) / 4.0
            return np.concatenate([(model.motion(unit) - motion).ravel(), shape])

        # the ellipsoid, and small other squares that tell from which side to leave it
        first = np.diag([1.0, 1.0, 1.0 / start.arm]) / ratio
        others = [np.diag(0.3 + 0.2 * np.roll([0.0, 1.0, 2.0], k)) / ratio for k in range(1, _SQUARES)]
        begin = np.array([factor[_LOWER] for factor in (first, *others)]).ravel()
        found = of(least_squares(errors, begin, method="lm").x)
        return cls(found.squares / np.linalg.norm(load, axis=1).mean() ** 2)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
