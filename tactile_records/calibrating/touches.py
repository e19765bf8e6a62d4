"""Touches in a run: where an arm says that the sensor was when its skin first met a surface.

Presence tells contact a little after it began, at a depth that depends on where the skin is touched. Over
the first tenths of a millimetre its score grows with the depth d as c (d - d_0)^p; with one p for all touches
of a run, which is found with them, d_0 is where contact began. A sensor without such scores is taken where
presence changed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from tactile_records.runs.record import RunRecord

Array = NDArray[np.float64]

LOWEST, HIGHEST = 0.005, 0.1  # scores between which they are taken for a power of the depth
_LEAST_SAMPLES = 5
_TURNED = 0.01  # rad; what turns meanwhile is no touch
_STEP = 2e-6  # m, by which the sensor goes on from image to image while it touches


@dataclass(frozen=True)
class Touch:
    """One touch.

    Attributes
    ----------
    T_base_sensor : ndarray (4, 4)
        Where the arm said that the sensor was when contact began.
    way, score : ndarray (N,)
        Way of the sensor (m) past that place, and presence's score, while the touch began.
    """

    T_base_sensor: Array
    way: Array
    score: Array


def touches_of(record: RunRecord) -> list[Touch]:
    """All touches of a run, in their order; empty where its presence never changes."""
    presence = record.presence
    if not len(record.pose) or not len(presence):
        return []
    low, high = record.pose.stamp_ns.min(), record.pose.stamp_ns.max()
    presence = presence.rows((presence.stamp_ns >= low) & (presence.stamp_ns <= high))
    T = record.pose.at(presence.stamp_ns)
    begins = np.flatnonzero(presence.in_contact[1:] & ~presence.in_contact[:-1]) + 1
    groups = [group for begin in begins if (group := _beginning(T, presence.score, int(begin))) is not None]
    if not groups:
        return []
    ways = [_way(T, group) for group in groups]
    scores = [presence.score[group] for group in groups]
    curved = min(int(((s > 0.0) & (s < HIGHEST)).sum()) for s in scores) >= _LEAST_SAMPLES
    if curved:
        starts = _extrapolated(ways, scores)
    else:  # half-way between the last image without contact and the first with it
        inside = [presence.in_contact[group] for group in groups]
        starts = [
            0.5 * float(way[~touched].max(initial=way[0]) + way[touched].min())
            for way, touched in zip(ways, inside, strict=True)
        ]
    return [
        _touch(T[group], way, start, score)
        for group, way, start, score in zip(groups, ways, starts, scores, strict=True)
    ]


def _beginning(T: Array, score: Array, begin: int) -> NDArray[np.int64] | None:
    """Indices about the begin of a contact between which the sensor goes on straight; None if it turns."""
    first = last = begin
    while first > 0 and score[first] > LOWEST and _goes_on(T, first - 1, begin):
        first -= 1
    while last + 1 < len(T) and score[last] < HIGHEST and _goes_on(T, last, begin):
        last += 1
    turn = Rotation.from_matrix(T[first, :3, :3].T @ T[last, :3, :3]).magnitude()
    return np.arange(first, last + 1, dtype=np.int64) if last > first and turn < _TURNED else None


def _goes_on(T: Array, index: int, begin: int) -> bool:
    """Whether from this image to the next one the sensor moves the way that it moved when contact began."""
    step, wanted = (T[i + 1, :3, 3] - T[i, :3, 3] for i in (index, begin - 1))
    return float(step @ wanted) > _STEP * float(np.linalg.norm(wanted))


def _way(T: Array, group: NDArray[np.int64]) -> Array:
    """How far along its line the sensor is at each index of the group, m."""
    line = T[group[-1], :3, 3] - T[group[0], :3, 3]
    return np.asarray((T[group, :3, 3] - T[group[0], :3, 3]) @ line / np.linalg.norm(line))


def _extrapolated(ways: list[Array], scores: list[Array]) -> list[float]:
    """Where on its way each touch began, by the power of the depth that suits all of them best."""

    def fitted(power: float) -> tuple[list[float], float]:
        starts, squares = [], 0.0
        for way, score in zip(ways, scores, strict=True):
            root = np.maximum(score, 0.0) ** (1.0 / power)
            slope, start = np.polyfit(root, way, 1)
            starts.append(float(start))
            squares += float(np.sum((start + slope * root - way) ** 2))
        return starts, squares

    best = minimize_scalar(lambda power: fitted(power)[1], bounds=(0.7, 3.0), method="bounded")
    return fitted(float(best.x))[0]


def _touch(T: Array, way: Array, start: float, score: Array) -> Touch:
    at = T[0].copy()
    line = T[-1, :3, 3] - T[0, :3, 3]
    at[:3, 3] += start * line / np.linalg.norm(line)
    return Touch(at, way - start, score)
