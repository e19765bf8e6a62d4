"""What a data set's labels alone tell: ranges, coverage, balance, repetitions, order of the rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from tactile_perception.estimating.labels import EULER_COMPONENTS

Array = NDArray[np.float64]

SECTORS, RINGS = 8, 3
FEW = 30  # fewer samples tell nothing of how they are spread
_SURE = 1e-4  # probability by chance below which something counts as found
_UNEVEN = 0.1  # largest distance of distributions that is still even
_CORRELATED = 0.2
_OFF_CENTER = 0.15  # mean over half range


@dataclass(frozen=True)
class Spread:
    """How evenly one quantity fills its range.

    Attributes
    ----------
    distance : largest distance (Kolmogorov-Smirnov) from an even distribution, 0 to 1
    emptiest, fullest : samples in the least and the most filled of ten equal parts
    even : bool
    """

    name: str
    distance: float
    emptiest: int
    fullest: int
    even: bool


@dataclass(frozen=True)
class LabelStatistics:
    """What was found in the labels (n, 6), mm and degrees.

    Attributes
    ----------
    ranges : (6, 4) least, largest, mean and standard deviation of each component
    constant : components that never change
    off_center : components, depth aside, whose mean is far off the middle between -max and max
    correlated : pairs with a correlation worth knowing
    spreads : of shear over its disk, depth, contact angles over their cap, and rotation
    sectors : (RINGS, SECTORS) int, for shear and for contact angles
        Samples in rings of equal area and in sectors.
    repeated : labels that occur more than once
    sorted_by : component that never falls from row to row (or never rises), or ""
    outliers : rows with a component beyond six standard deviations, or of an impossible size
    """

    ranges: Array
    constant: list[str]
    off_center: list[str]
    correlated: list[tuple[str, str, float]]
    spreads: list[Spread]
    shear_sectors: NDArray[np.int64]
    tilt_sectors: NDArray[np.int64]
    repeated: int
    sorted_by: str
    outliers: list[int]


def label_statistics(euler_mm_deg: Array) -> LabelStatistics:
    """Look at labels (n, 6) in mm and degrees."""
    labels = np.asarray(euler_mm_deg, dtype=np.float64)
    ranges = np.stack([labels.min(0), labels.max(0), labels.mean(0), labels.std(0)], axis=1)
    moving = ranges[:, 1] > ranges[:, 0]
    constant = [name for name, moves in zip(EULER_COMPONENTS, moving, strict=True) if not moves]
    radius, angle = _polar(labels[:, 0], labels[:, 1])
    alpha, beta = np.radians(labels[:, 3]), np.radians(labels[:, 4])
    # the sensor's axis in {f}: uniform over a cap by the paper's sampling
    lean = np.sqrt(np.maximum(0.0, 2.0 * (1.0 - np.cos(alpha) * np.cos(beta))))
    _, azimuth = _polar(np.cos(alpha) * np.sin(beta), -np.sin(alpha))
    spreads = [
        _spread("x, y over their disk", radius**2),
        _spread("z", labels[:, 2]),
        _spread("alpha, beta over their cap", lean**2),
        _spread("gamma", labels[:, 5]),
    ]
    return LabelStatistics(
        ranges,
        constant,
        _off_center(labels, moving),
        _correlated(labels, moving),
        [spread for spread in spreads if spread is not None],
        _sectors(radius, angle),
        _sectors(lean, azimuth),
        len(labels) - len(np.unique(labels, axis=0)),
        _sorted_by(labels, moving),
        _outliers(labels),
    )


def _polar(x: Array, y: Array) -> tuple[Array, Array]:
    return np.hypot(x, y), np.arctan2(y, x)


def _spread(name: str, values: Array) -> Spread | None:
    low, high = values.min(), values.max()
    if high <= low or len(values) < FEW:
        return None
    scaled = (values - low) / (high - low)
    distance, chance = stats.kstest(scaled, "uniform")
    counts = np.histogram(scaled, bins=10, range=(0.0, 1.0))[0]
    even = distance < _UNEVEN or chance > _SURE
    return Spread(name, float(distance), int(counts.min()), int(counts.max()), bool(even))


def _sectors(radius: Array, angle: Array) -> NDArray[np.int64]:
    """Samples (RINGS, SECTORS) in rings of equal area and equal sectors."""
    largest = max(float(radius.max()), 1e-12)
    ring = np.minimum((RINGS * (radius / largest) ** 2).astype(int), RINGS - 1)
    sector = ((angle / (2 * np.pi)) % 1.0 * SECTORS).astype(int) % SECTORS
    counts = np.zeros((RINGS, SECTORS), dtype=np.int64)
    np.add.at(counts, (ring, sector), 1)
    return counts


def _off_center(labels: Array, moving: NDArray[np.bool_]) -> list[str]:
    found = []
    for k, name in enumerate(EULER_COMPONENTS):
        values = labels[:, k]
        largest = np.abs(values).max()
        if name == "z" or not moving[k] or largest == 0.0:
            continue
        error = values.std() / np.sqrt(len(values))
        if abs(values.mean()) > max(_OFF_CENTER * largest, 5.0 * error):
            found.append(name)
    return found


def _correlated(labels: Array, moving: NDArray[np.bool_]) -> list[tuple[str, str, float]]:
    pairs = []
    for i in range(6):
        for j in range(i + 1, 6):
            if moving[i] and moving[j]:
                r, chance = stats.pearsonr(labels[:, i], labels[:, j])
                if abs(r) > _CORRELATED and chance < _SURE:
                    pairs.append((EULER_COMPONENTS[i], EULER_COMPONENTS[j], float(r)))
    return pairs


def _sorted_by(labels: Array, moving: NDArray[np.bool_]) -> str:
    for k, name in enumerate(EULER_COMPONENTS):
        steps = np.diff(labels[:, k])
        if moving[k] and len(steps) > 10 and (np.all(steps >= 0) or np.all(steps <= 0)):
            return name
    return ""


def _outliers(labels: Array) -> list[int]:
    if len(labels) < FEW:
        return []
    center = np.median(labels, axis=0)
    spread = 1.4826 * np.median(np.abs(labels - center), axis=0)
    far = (np.abs(labels - center) > 8.0 * np.maximum(spread, 1e-12)) & (spread > 0)
    return np.flatnonzero(far.any(axis=1) | (np.abs(labels[:, 3:]) > 180.0).any(axis=1)).tolist()
