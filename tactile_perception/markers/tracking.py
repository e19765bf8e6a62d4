"""Markers of a whole data set, each followed from image to image without a video.

Samples of a data set are single images. Which blob of an image is which marker follows from the labels: from
shallow contacts to deep ones, a regression of every marker's position on the labels says where to look.
Signs and units of the labels do not matter: the regression finds what follows what.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

STEPS = 12
_FIRST_REACH, _REACH = 0.6, 0.45  # in distances between neighboring markers
_NEIGHBORS = 15
_RIDGE = 1e-2


def track(blobs: Sequence[Array], labels: Array, depth_order: NDArray[np.int64], rest: Array) -> Array:
    """Positions (n, markers, 2) of the markers, NaN where one was not found.

    Parameters
    ----------
    blobs : n arrays (k, 2) centers of the markers found in each image, px
    labels : (n, 6) in any units: they are scaled to their ranges
    depth_order : (n,) int, the samples from shallow to deep
    rest : (markers, 2) positions without contact, or in a shallow one
    """
    features = _features(_scaled(labels))
    spacing = float(np.median(cKDTree(rest).query(rest, k=2)[0][:, 1]))
    _, around = cKDTree(rest).query(rest, k=min(_NEIGHBORS, len(rest)))
    predicted = np.tile(rest, (len(blobs), 1, 1))
    positions = np.full_like(predicted, np.nan)
    shares = np.linspace(1.0 / STEPS, 1.0, STEPS)
    for step, share in enumerate([*shares, 1.0]):
        chosen = depth_order[: max(1, round(share * len(depth_order)))]
        reach = spacing * (_FIRST_REACH if step == 0 else _REACH)
        for i in chosen:
            positions[i] = _followed(predicted[i], blobs[i], reach, around)
        basis = features[:, :7] if step == 0 else features
        predicted = _regressed(basis, positions, chosen, predicted)
    return positions


def _regressed(basis: Array, positions: Array, chosen: NDArray[np.int64], before: Array) -> Array:
    """Where each marker should be in every image, by a ridge regression over those in which it was seen."""
    predicted = before.copy()
    ridge = _RIDGE * np.eye(basis.shape[1])
    for marker in range(positions.shape[1]):
        seen = chosen[np.isfinite(positions[chosen, marker, 0])]
        if len(seen) > 3:
            a = basis[seen]
            center = positions[seen, marker].mean(axis=0)
            weights = np.linalg.solve(a.T @ a + ridge, a.T @ (positions[seen, marker] - center))
            predicted[:, marker] = center + basis @ weights
    return predicted


def _followed(predicted: Array, blobs: Array, reach: float, around: NDArray[np.int64]) -> Array:
    """Blobs (markers, 2) near the predictions, after these have been moved as their neighbors were.

    Slip moves all markers of a neighborhood by what no label describes; one that moves otherwise is another.
    """
    moved = predicted
    for part in (1.0, 1.0, 0.6):
        found = _mutual_nearest(moved, blobs, part * reach)
        off = (found - predicted)[around]
        seen = np.isfinite(off[..., :1])
        near = np.where(seen, off, 0.0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
        moved = predicted + near
    return found


def _mutual_nearest(markers: Array, blobs: Array, reach: float) -> Array:
    if not len(blobs):
        return np.full_like(markers, np.nan)
    distance, nearest = cKDTree(blobs).query(markers)
    _, back = cKDTree(markers).query(blobs)
    found = (distance < reach) & (back[nearest] == np.arange(len(markers)))
    return np.where(found[:, None], blobs[nearest], np.nan)


def _scaled(labels: Array) -> Array:
    """Labels in [-1, 1], so that all weigh alike in the regression; the depth in [0, 1] from shallow on."""
    middle = (labels.max(axis=0) + labels.min(axis=0)) / 2
    half = np.maximum((labels.max(axis=0) - labels.min(axis=0)) / 2, 1e-12)
    return (labels - middle) / half


def _features(scaled: Array) -> Array:
    """Constant, linear terms, and the products by which a soft contact bends them."""
    x, y, z, a, b, g = scaled.T
    columns = [np.ones_like(x), x, y, z, a, b, g, z * z]
    columns += [v * z for v in (x, y, a, b, g)] + [v * z * z for v in (x, y, a, b, g)]
    for p, q in ((x, x), (y, y), (x, y), (a, a), (b, b), (a, b), (x, a), (x, b), (y, a), (y, b)):
        columns += [p * q, p * q * z]
    return np.stack(columns, axis=1)
