"""Markers of a TacTip data folder, tracked by their rings: used by the comparisons of simulation and reality.

The images of the public layout are thresholded; markers are their blobs. Which blob is which marker follows
from the rings at rest and, as contacts get deeper, from a regression of the marker positions on the labels
that is refined from shallow to deep.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from tactile_perception.dataset import TactileFolder, open_folder

RINGS = 10
DEPTH_STEPS = (0.7, 0.8, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.1, 6.1)  # mm


@dataclass(frozen=True)
class Tracked:
    """Tracked markers of a folder.

    Attributes
    ----------
    folder : TactileFolder
    index : (n,) int, rows of the folder
    labels : (n, 6) mm and degrees
    rest : (331, 2) px of the camera image: column, row
    positions : (n, 331, 2) px, NaN where a marker was not found
    ring : (331,) int
    """

    folder: TactileFolder
    index: np.ndarray
    labels: np.ndarray
    rest: np.ndarray
    positions: np.ndarray
    ring: np.ndarray


def track(folder: Path, samples: int | None = None) -> Tracked:
    """Track the markers of up to `samples` images of a folder, chosen at random."""
    data = open_folder(folder)
    index = np.arange(len(data))
    if samples is not None and samples < len(index):
        index = np.sort(np.random.default_rng(0).choice(index, samples, replace=False))
    labels = data.euler_mm_deg[index]
    blobs = [blob_centres(data.image(i)) for i in index]
    shallow = np.flatnonzero(labels[:, 2] < DEPTH_STEPS[0])
    template, ring = ring_template(blobs[shallow[np.argmin(np.hypot(*labels[shallow, :2].T))]])
    positions = _refine(blobs, labels, template)
    offset = np.array(data.preprocessing.bbox[:2])
    rest = np.nanmedian(positions[shallow], axis=0) + offset
    return Tracked(data, index, labels, rest, positions + offset, ring)


def blob_centres(binary: np.ndarray) -> np.ndarray:
    """Centres (n, 2) of blobs of a marker's size."""
    smooth = cv2.medianBlur(binary, 5)
    _, _, stats, centres = cv2.connectedComponentsWithStats((smooth > 127).astype(np.uint8))
    size = stats[:, cv2.CC_STAT_AREA]
    wide = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT])
    keep = (size > 40) & (size < 300) & (wide < 24)
    keep[0] = False
    return centres[keep]


def ring_template(centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rings of 1, 6, 12, ... fitted to a shallow contact's blobs: positions (331, 2) and ring numbers."""
    middle = np.median(centres, axis=0)
    inside = centres[np.hypot(*(centres - middle).T) < 215]
    middle = (inside.max(axis=0) + inside.min(axis=0)) / 2
    order = np.argsort(np.hypot(*(inside - middle).T))
    ring = np.concatenate([[k] * max(6 * k, 1) for k in range(RINGS + 1)])
    azimuth = np.concatenate([2 * np.pi * np.arange(max(6 * k, 1)) / max(6 * k, 1) for k in range(RINGS + 1)])
    sorted_radius = np.hypot(*(inside[order] - middle).T)
    radius = np.array(
        [np.median(sorted_radius[np.flatnonzero(ring[: len(order)] == k)]) for k in range(RINGS + 1)]
    )
    radius[0] = 0.0
    return middle + radius[ring, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1), ring


def _refine(blobs: list[np.ndarray], labels: np.ndarray, template: np.ndarray) -> np.ndarray:
    """Assign blobs to markers from shallow to deep contacts."""
    features = _features(labels / np.array([5, 5, 6, 25, 25, 5]))
    predicted = np.tile(template, (len(blobs), 1, 1))
    positions = np.full_like(predicted, np.nan)
    for step, depth in enumerate(DEPTH_STEPS):
        chosen = np.flatnonzero(labels[:, 2] < depth)
        for i in chosen:
            positions[i] = _mutual_nearest(predicted[i], blobs[i], 12 if step == 0 else 9)
        basis = features if step > 1 else features[:, :1]
        for m in range(len(template)):
            seen = chosen[np.isfinite(positions[chosen, m, 0])]
            a = basis[seen]
            ridge = 1e-2 * np.eye(a.shape[1])
            predicted[:, m] = basis @ np.linalg.solve(a.T @ a + ridge, a.T @ positions[seen, m])
    return positions


def _mutual_nearest(markers: np.ndarray, blobs: np.ndarray, reach: float) -> np.ndarray:
    distance, nearest = cKDTree(blobs).query(markers)
    _, back = cKDTree(markers).query(blobs)
    found = (distance < reach) & (back[nearest] == np.arange(len(markers)))
    return np.where(found[:, None], blobs[nearest], np.nan)


def _features(scaled: np.ndarray) -> np.ndarray:
    x, y, z, a, b, g = scaled.T
    columns = [np.ones_like(x), z, z * z]
    for v in (x, y, a, b, g):
        columns += [v, v * z, v * z * z, np.sqrt(z) * v]
    for p, q in ((x, x), (y, y), (x, y), (a, a), (b, b), (a, b), (x, a), (x, b), (y, a), (y, b)):
        columns += [p * q, p * q * z]
    return np.stack(columns, axis=1)
