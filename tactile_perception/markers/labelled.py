"""Markers of a labelled TacTip data folder, told apart and tracked.

`tactile_perception.markers.detection` finds the markers of each image. Which is which follows from the rings
at rest, from a regression of the marker positions on the labels, refined from shallow to deep contacts, and
then from the neighbors: starting where the regression is right to a few pixels, each marker is expected
where its neighbors' displacements put it, so that the matching grows over the image and follows contacts that
slipped as well as those that stuck.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tactile_perception.datasets.folder import TactileFolder
from tactile_perception.markers.detection import detect

Array = NDArray[Any]
Progress = Callable[[int, int], None]  # images done, of how many

RINGS = 10
DEPTH_STEPS = (0.7, 0.8, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.1, 6.1)  # mm
DEEPEST_REST = 1.2  # mm; deeper than that no marker is near where it rests
SHALLOW = 0.2  # mm beyond the shallowest contact, in which markers are about where they rest
NEIGHBORS = 18
REACH = 6.0  # px, about a third of the distance between markers
FEWEST_SEEN = 0.8  # part of the markers, in the shallow contact that everything starts from
CONSISTENT = 4.0  # px between a marker and where its neighbors put it
PASSES = 3  # of regression and growth


@dataclass(frozen=True)
class Tracked:
    """Tracked markers of a folder.

    Attributes
    ----------
    labels : (n, 6) mm and degrees
    rest : (331, 2) px of the camera image: column, row
    positions : (n, 331, 2) px, NaN where a marker was not found
    ring : (331,) int
    """

    labels: Array
    rest: Array
    positions: Array
    ring: Array

    @property
    def found(self) -> Array:
        """Part of the markers found in each image (n,)."""
        return np.isfinite(self.positions[..., 0]).mean(axis=1)

    def some(self, count: int, seed: int, least_found: float = 0.96) -> Array:
        """Random images (count,) in which nearly all markers were found."""
        good = np.flatnonzero(self.found >= least_found)
        return np.random.default_rng(seed).choice(good, min(count, len(good)), replace=False)


def track(data: TactileFolder, rows: Array, progress: Progress | None = None) -> Tracked:
    """Track the markers of these images (n,) of a data folder, all of one sensor.

    Raises
    ------
    ValueError
        There is no contact less than `DEEPEST_REST` deep, in which the markers are about where they rest,
        or it does not show the rings of 331.
    """
    data.check_labelled()
    labels = data.euler_mm_deg[rows]
    offset, blobs = np.zeros(2), []
    for row in rows:
        image = data.image(int(row))
        blobs.append(detect(image).centers)
        if image.shape[:2] == data.preprocessing.crop_shape:
            offset = np.array(data.preprocessing.bbox[:2])
    if labels[:, 2].min() > DEEPEST_REST:
        raise ValueError(f"{data.folder}: must have contacts less than {DEEPEST_REST} mm deep, has none")
    first = max(DEPTH_STEPS[0], labels[:, 2].min() + SHALLOW)
    steps = (first, *(depth for depth in DEPTH_STEPS if depth > first))
    shallow = np.flatnonzero(labels[:, 2] < first)
    template, ring = ring_template(blobs[shallow[np.argmin(np.hypot(*labels[shallow, :2].T))]])
    features = _features(labels / np.array([5, 5, 6, 25, 25, 5]))
    positions = _refine(blobs, labels, features, template, steps)
    rest = np.ma.median(np.ma.masked_invalid(positions[shallow]), axis=0).filled(template)
    neighbors = _Neighbors(rest)
    for number in range(PASSES):
        predicted = np.stack(
            [_regressed(features, positions[:, m], np.arange(len(rows))) for m in range(len(rest))], axis=1
        )
        for i, (seen, expected) in enumerate(zip(blobs, predicted, strict=True)):
            positions[i] = _grow(seen, neighbors, expected)
            if progress is not None:
                progress(number * len(rows) + i + 1, PASSES * len(rows))
    return Tracked(labels, rest + offset, positions + offset, ring)


def ring_template(centres: Array) -> tuple[Array, Array]:
    """Rings of 1, 6, 12, ... fitted to a shallow contact's blobs: positions (331, 2) and ring numbers.

    `ValueError` where there are too few blobs for that.
    """
    middle = np.median(centres, axis=0)
    inside = centres[np.hypot(*(centres - middle).T) < 215]
    middle = (inside.max(axis=0) + inside.min(axis=0)) / 2
    order = np.argsort(np.hypot(*(inside - middle).T))
    ring = np.concatenate([[k] * max(6 * k, 1) for k in range(RINGS + 1)])
    if len(inside) < FEWEST_SEEN * len(ring):
        raise ValueError(
            f"a shallow contact shows {len(inside)} markers: needs most of the {len(ring)} that lie in "
            f"{RINGS} rings about one in the middle"
        )
    azimuth = np.concatenate([2 * np.pi * np.arange(max(6 * k, 1)) / max(6 * k, 1) for k in range(RINGS + 1)])
    sorted_radius = np.hypot(*(inside[order] - middle).T)
    radius = np.array(
        [np.median(sorted_radius[np.flatnonzero(ring[: len(order)] == k)]) for k in range(RINGS + 1)]
    )
    radius[0] = 0.0
    return middle + radius[ring, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1), ring


def _refine(
    blobs: list[Array], labels: Array, features: Array, template: Array, steps: tuple[float, ...]
) -> Array:
    """Assign blobs to markers from shallow to deep contacts, in steps of depth (mm)."""
    predicted = np.tile(template, (len(blobs), 1, 1))
    positions = np.full_like(predicted, np.nan)
    for step, depth in enumerate(steps):
        chosen = np.flatnonzero(labels[:, 2] < depth)
        for i in chosen:
            positions[i] = _mutual_nearest(predicted[i], blobs[i], 12 if step == 0 else 9)
        basis = features if step > 1 else features[:, :1]
        for m in range(len(template)):
            predicted[:, m] = _regressed(basis, positions[:, m], chosen)
    return positions


def _regressed(basis: Array, positions: Array, chosen: Array) -> Array:
    """Positions (n, 2) of one marker by ridge regression on those of the chosen images where it was found."""
    seen = chosen[np.isfinite(positions[chosen, 0])]
    a = basis[seen]
    ridge = 1e-2 * np.eye(a.shape[1])
    return basis @ np.linalg.solve(a.T @ a + ridge, a.T @ positions[seen])


class _Neighbors:
    """Where each marker is expected by a local affine fit to its neighbors' displacements."""

    def __init__(self, rest: Array) -> None:
        self.rest = rest
        self._near = cKDTree(rest).query(rest, k=NEIGHBORS + 1)[1][:, 1:]
        offset = rest[self._near] - rest[:, None]
        offset /= np.linalg.norm(offset[:, 0], axis=1).mean()
        self._weight = np.exp(-0.5 * (np.linalg.norm(offset, axis=2) / 1.2) ** 2)
        self._basis = np.concatenate([np.ones((*offset.shape[:2], 1)), offset], axis=2)

    def expected(self, positions: Array) -> Array:
        """Positions (331, 2) by those of the neighbors; NaN with fewer than five of them."""
        displacement = positions - self.rest
        known = np.isfinite(displacement[self._near, 0])
        weighted = self._basis * (self._weight * known)[:, :, None]
        normal = weighted.transpose(0, 2, 1) @ self._basis + np.diag([1e-9, 0.02, 0.02])
        seen = np.where(known[:, :, None], displacement[self._near], 0.0)
        out = self.rest + np.linalg.solve(normal, weighted.transpose(0, 2, 1) @ seen)[:, 0]
        out[known.sum(axis=1) < 5] = np.nan
        return out


def _grow(blobs: Array, neighbors: _Neighbors, predicted: Array, rounds: int = 14) -> Array:
    """Positions (331, 2) in one image, grown from where the prediction is right to a few pixels."""
    found = np.full_like(predicted, np.nan)
    for _ in range(rounds):
        found = _mutual_nearest(predicted, blobs, REACH)
        found[np.linalg.norm(found - neighbors.expected(found), axis=1) > CONSISTENT] = np.nan
        expected = neighbors.expected(found)
        expected = np.where(np.isfinite(expected), expected, predicted)
        if np.abs(expected - predicted).max() < 0.05:
            break
        predicted = expected
    return found


def _mutual_nearest(markers: Array, blobs: Array, reach: float) -> Array:
    distance, nearest = cKDTree(blobs).query(markers)
    _, back = cKDTree(markers).query(blobs)
    found = (distance < reach) & (back[nearest] == np.arange(len(markers)))
    return np.where(found[:, None], blobs[nearest], np.nan)


def _features(scaled: Array) -> Array:
    x, y, z, a, b, g = scaled.T
    columns = [np.ones_like(x), z, z * z]
    for v in (x, y, a, b, g):
        columns += [v, v * z, v * z * z, np.sqrt(z) * v]
    for p, q in ((x, x), (y, y), (x, y), (a, a), (b, b), (a, b), (x, a), (x, b), (y, a), (y, b)):
        columns += [p * q, p * q * z]
    return np.stack(columns, axis=1)
