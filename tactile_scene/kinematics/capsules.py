"""Capsules: what links of arms are for distances; each is all that is within a radius of a segment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SMALLEST = 1e-12  # m^2; a segment shorter than a micrometre is a point


@dataclass(frozen=True)
class Capsules:
    """Some capsules in one frame.

    Attributes
    ----------
    ends : ndarray (n, 2, 3)
        First and last point of each one's segment, m.
    radii : ndarray (n,)
        m.
    joints : ndarray (n,) of int
        The joint that each moves with, from 1; 0 for one that stands with the base.
    """

    ends: Array
    radii: Array
    joints: NDArray[np.intp]

    def moved(self, T: Array) -> Capsules:
        """A copy in another frame; T (4, 4) is this frame in that one."""
        return Capsules(self.ends @ T[:3, :3].T + T[:3, 3], self.radii, self.joints)


@dataclass(frozen=True)
class Gaps:
    """How far capsules of one set are from those of another, for k pairs.

    Attributes
    ----------
    first, second : ndarray (k,) of int
        Which of each set.
    distances : ndarray (k,)
        Between their surfaces, m; negative where they overlap.
    points : ndarray (k, 3)
        On the first's segment, nearest to the second's.
    towards : ndarray (k, 3)
        Unit vectors from there to the second; zero where the segments meet.
    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]
    distances: Array
    points: Array
    towards: Array


def gaps(first: Capsules, second: Capsules, within: float = np.inf) -> Gaps:
    """The gaps between capsules of two sets in one frame; pairs further apart than `within` (m) may miss."""
    i, j = np.nonzero(_at_least(first, second) <= within)
    a, b, c, d = first.ends[i, 0], first.ends[i, 1], second.ends[j, 0], second.ends[j, 1]
    s, t = _nearest(a, b, c, d)
    points = a + s[:, None] * (b - a)
    ways = c + t[:, None] * (d - c) - points
    lengths = np.sqrt(_dot(ways, ways))
    towards = np.divide(ways, lengths[:, None], out=np.zeros_like(ways), where=lengths[:, None] > 0.0)
    return Gaps(i, j, lengths - first.radii[i] - second.radii[j], points, towards)


def _at_least(first: Capsules, second: Capsules) -> Array:
    """A distance (n, m) that each pair has at the least: that of the spheres around them."""
    (p, r), (q, s) = _spheres(first), _spheres(second)
    ways = p[:, None] - q[None]
    return np.asarray(np.sqrt(_dot(ways, ways)) - r[:, None] - s[None])


def _spheres(capsules: Capsules) -> tuple[Array, Array]:
    half = 0.5 * (capsules.ends[:, 1] - capsules.ends[:, 0])
    return capsules.ends[:, 0] + half, np.sqrt(_dot(half, half)) + capsules.radii


def _nearest(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array]:
    """Where (0..1) segments a-b and c-d are nearest to each other; points (k, 3).

    The distance is convex in both, so the least is where the lines are nearest, if that is on both segments,
    or at an end of one of them: the best of these five.
    """
    u, v, w = b - a, d - c, a - c
    uu, uv, vv, uw, vw = _dot(u, u), _dot(u, v), _dot(v, v), _dot(u, w), _dot(v, w)
    area = uu * vv - uv * uv
    skew = area > 1e-12 * uu * vv  # else parallel, and an end is among the nearest
    zero, one = np.zeros_like(area), np.ones_like(area)
    inside = np.divide(uv * vw - vv * uw, area, out=zero.copy(), where=skew)
    inside = np.clip(inside, 0.0, 1.0)
    s = np.stack([inside, zero, one, _part(-uw, uu), _part(uv - uw, uu)])
    t = np.stack([_part(uv * inside + vw, vv), _part(vw, vv), _part(uv + vw, vv), zero, one])
    ways = w + s[..., None] * u - t[..., None] * v
    best = _dot(ways, ways).argmin(axis=0)[None]
    return np.take_along_axis(s, best, 0)[0], np.take_along_axis(t, best, 0)[0]


def _part(along: Array, square: Array) -> Array:
    return np.clip(np.divide(along, square, out=np.zeros_like(along), where=square > _SMALLEST), 0.0, 1.0)


def _dot(x: Array, y: Array) -> Array:
    return np.asarray((x * y).sum(axis=-1))
