"""The way of a pushed object to a pose: to where its contact is to be, and in which direction.

Where a contact that sticks moves at u sideways and v ahead, its normal turns by a u + b v (`steering`). The
point at 1 / a ahead of it on the normal then moves on a course of its own, b / a to the right of the normal,
whatever u is: it goes like a car, whose curvature u sets, at most a u_max / v to either side. It is led along
a cubic curve from where it is, tangent to its course there, to where it is to be, tangent to its course then;
the last part is a straight line. The curve is planned anew at each step, for what a and b are by then; of it
only the curvature at its beginning counts.

Positions (2,) are y and z in the reference sensor frame {s'}; angles go from its z-axis to its y-axis, which
is the left.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TIGHTEST = 100.0  # 1/m
_JOIN = math.sqrt(6.0)  # of `line`: there curve and line answer an offset alike


def curvature(end: Array, turn: float, reach: float, crab: float, straight: float, line: float) -> float:
    """Curvature (1/m, to the left) that leads to a pose.

    Parameters
    ----------
    end : ndarray (2,)
        Where the sensor's centre is to be, m.
    turn : float
        Of the normal up to there, rad.
    reach, crab : float
        1 / a, m; b / a, rad.
    straight : float
        Length of the straight part, m.
    line : float
        Way in which an offset from it is taken away, m.
    """
    course = turn - crab
    way = end + reach * (_along(turn) - _along(0.0)) - straight * _along(course)
    if way @ _along(course) > _JOIN * line:
        bearing = _wrapped(math.atan2(way[0], way[1]) + crab)
        if abs(bearing) > 0.5 * math.pi:
            return math.copysign(TIGHTEST, bearing)
        return (6.0 * math.sin(bearing) - 2.0 * math.sin(turn)) / math.hypot(*way)
    beside = -(way @ np.array([math.cos(course), -math.sin(course)]))
    return -(beside / line - 2.0 * _wrapped(turn)) / line


def largest_curvature(end: Array, turn: float, reach: float, straight: float) -> float:
    """Largest curvature (1/m) of the curve to a pose, for an object that does not turn by itself."""
    way = end + reach * (_along(turn) - _along(0.0)) - straight * _along(turn)
    size = math.hypot(*way)
    part = np.linspace(0.0, 1.0, 100)[:, None]
    first, last = size * _along(0.0), size * _along(turn)
    speed = 6.0 * part * (1.0 - part) * way + (1.0 - part) * (1.0 - 3.0 * part) * first
    speed += part * (3.0 * part - 2.0) * last
    change = 6.0 * (1.0 - 2.0 * part) * way + (6.0 * part - 4.0) * first + (6.0 * part - 2.0) * last
    area = np.abs(speed[:, 0] * change[:, 1] - speed[:, 1] * change[:, 0])
    return float((area / np.maximum(np.hypot(*speed.T), 1e-9) ** 3).max())


def _along(angle: float) -> Array:
    return np.array([math.sin(angle), math.cos(angle)])


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
