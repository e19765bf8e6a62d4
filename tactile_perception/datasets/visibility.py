"""How much of each component of the labels shows in the images of a data set.

What moves in the images (markers, or gray levels where none are followed) is regressed on all labels, and on
all but one: on samples that were held out, the errors grow by the share that this one explains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_perception.estimating.image import Image
from tactile_perception.estimating.labels import EULER_COMPONENTS

Array = NDArray[np.float64]

FEWEST = 100  # samples
_FOLDS = 5
_HARDLY = 0.05  # of the noise
_BETTER = 0.98  # of the noise: what is truly in a label makes it far larger when it is left out
_WIDE_DEG = 90.0  # range from which an angle counts by its sine and cosine
_RIDGE = 1e-6
_SIDE = 16  # px, of images whose gray levels are compared


@dataclass(frozen=True)
class Visibility:
    """Shares of the variance of what moves in the images, each over all samples.

    Attributes
    ----------
    shares : what is explained by a component alone, with its products with others; 0 to 1
    noise : what no label explains
    of : "marker motion" or "image change"
    """

    shares: dict[str, float]
    noise: float
    of: str

    @property
    def hardly(self) -> list[str]:
        """Components of which images tell next to nothing."""
        return [name for name, share in self.shares.items() if share < _HARDLY * self.noise]


def of_markers(labels: Array, positions: Array, labelled: Sequence[str]) -> Visibility:
    """By markers (n, markers, 2), NaN where one was not found; labels (n, 6), the angles in degrees."""
    return _visibility(labels, positions, labelled, "marker motion")


def better_parts(pose: Array, shear: Array, positions: Array, labelled: Sequence[str]) -> dict[str, str]:
    """Components of pose and shear (n, 6), both varying, of which markers follow one better than the sum.

    Tools differ in what they mean: a motion after the contact, or the one that led to the pose in the table.
    """
    both = np.flatnonzero((np.ptp(pose, axis=0) > 0.0) & (np.ptp(shear, axis=0) > 0.0))
    if not len(both):
        return {}
    noise = of_markers(pose + shear, positions, labelled).noise
    found = {}
    for k in both:
        for part, values in (("pose", pose), ("shear", shear)):
            labels = pose + shear
            labels[:, k] = values[:, k]
            if of_markers(labels, positions, labelled).noise < _BETTER * noise:
                found[EULER_COMPONENTS[k]] = part
    return found


def of_images(labels: Array, images: Sequence[Image], labelled: Sequence[str]) -> Visibility:
    """By gray levels of images made small."""
    small = [cv2.resize(image, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA) for image in images]
    return _visibility(labels, np.array(small, float).reshape(len(small), -1, 1), labelled, "image change")


def _visibility(labels: Array, shown: Array, labelled: Sequence[str], of: str) -> Visibility:
    names = [
        name for k, name in enumerate(EULER_COMPONENTS) if name in labelled and np.ptp(labels[:, k]) > 0.0
    ]
    basis, parts = _basis(labels[:, [EULER_COMPONENTS.index(name) for name in names]], names)
    seen = np.isfinite(shown[..., 0])
    known = seen.sum(axis=0) > 2 * basis.shape[1]
    seen, shown = seen[:, known], np.where(seen[..., None], shown, 0.0)[:, known]
    shown = (shown - shown.sum(axis=0) / seen.sum(axis=0)[:, None]) * seen[..., None]
    kept = [np.array([k for k, part in enumerate(parts) if name not in part]) for name in ("", *names)]
    errors = _held_out_errors(basis, shown, seen, kept) / max(float((shown**2).sum()), 1e-12)
    shares = {name: max(0.0, float(error - errors[0])) for name, error in zip(names, errors[1:], strict=True)}
    return Visibility(shares, float(errors[0]), of)


def _basis(labels: Array, names: Sequence[str]) -> tuple[Array, list[set[str]]]:
    """Functions of the labels (n, functions) up to products of two, and the components in each of them."""
    columns, parts = [np.ones(len(labels))], [set[str]()]
    for values, name in zip(labels.T, names, strict=True):
        turn = np.radians(values)
        wide = name in EULER_COMPONENTS[3:] and np.ptp(values) > _WIDE_DEG
        for column in (np.cos(turn), np.sin(turn)) if wide else (values,):
            columns.append((column - column.mean()) / max(float(column.std()), 1e-12))
            parts.append({name})
    single = len(columns)
    for i in range(1, single):
        for j in range(i, single):
            columns.append(columns[i] * columns[j])
            parts.append(parts[i] | parts[j])
    return np.stack(columns, axis=1), parts


def _held_out_errors(
    basis: Array, shown: Array, seen: NDArray[np.bool_], kept: Sequence[NDArray[np.int64]]
) -> Array:
    """Sums of squared errors of samples that were held out, by the functions `kept` of each regression."""
    fold = np.random.default_rng(0).permutation(len(basis)) % _FOLDS
    products = (basis[:, :, None] * basis[:, None, :]).reshape(len(basis), -1)
    size = basis.shape[1]
    errors = np.zeros(len(kept))
    for held in range(_FOLDS):
        train, test = fold != held, fold == held
        normal = (seen[train].T.astype(float) @ products[train]).reshape(-1, size, size)
        normal += _RIDGE * len(basis) * np.eye(size)
        right = np.einsum("nb,nmd->mbd", basis[train], shown[train])
        for k, some in enumerate(kept):
            weights = np.linalg.solve(normal[:, some[:, None], some], right[:, some])
            left = shown[test] - np.einsum("nb,mbd->nmd", basis[test][:, some], weights)
            errors[k] += float((left**2 * seen[test][..., None]).sum())
    return errors
