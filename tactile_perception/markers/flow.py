"""How the markers of a data set move with its labels: what signs, units and frames can be read off images.

Written for a soft dome that is pressed and sheared on a surface, and a camera that looks out through the dome
along the sensor's z-axis: columns to the right and rows downward are then a right-handed frame seen along z,
and a direction (x, y) of the sensor is one in the image by a rotation C about z, unknown but one for all:

- the skin stays behind when the sensor shears by (x, y): markers in the contact move along -C (x, y);
- the place of contact in the sensor is along (-beta, alpha), and pressing spreads markers away from it, with
  a divergence k > 0: in the middle they move along -k C (-beta, alpha);
- the skin stays behind when the sensor turns by gamma: markers turn by -gamma, in columns and rows.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import LARGEST_SEED, Settings, setting
from tactile_perception.datasets.dataset import TactileFolder
from tactile_perception.estimating.image import Image, ImageError
from tactile_perception.estimating.preprocessing import Preprocessor
from tactile_perception.markers.detection import DetectionSettings, detect
from tactile_perception.markers.tracking import track

Array = NDArray[np.float64]

BOOTSTRAPS = 24
_SMALL = 64  # px, side of the images whose variety tells shallow from deep
_END_SHARE = 0.15
_LEAST_SEEN, _LEAST_MARKERS = 30, 10
_FEWEST = 60  # images
_FINE_SIDE = 200  # px, of an image in which markers are so small that a median would wipe them out


class FlowError(ValueError):
    """Images in which no markers can be followed."""


@dataclass(frozen=True)
class FlowSettings(Settings):
    """What of a data set is looked at."""

    samples: int = setting(500, lower=60, upper=100000, doc="images, chosen at random")
    seed: int = setting(0, lower=0, upper=LARGEST_SEED, doc="of the choice")
    inner: float = setting(0.5, lower=0.05, upper=1.0, doc="markers within this part of the radius count")
    ring: tuple[float, ...] = setting(
        (0.3, 0.7), lower=0.0, upper=1.0, length=2, doc="and for rotation those between these parts"
    )
    deep: float = setting(0.5, lower=0.0, upper=0.95, doc="in contacts deeper than this share of them")


@dataclass(frozen=True)
class Measured:
    """A value with its standard error, both of one shape."""

    value: Array
    error: Array

    @property
    def certain(self) -> bool:
        """Whether every number is five standard errors away from zero; of a map, its singular values."""
        if self.value.ndim == 2:
            least = np.linalg.svd(self.value, compute_uv=False).min()
            return bool(least > 5.0 * np.sqrt((self.error**2).mean()))
        return bool((np.abs(self.value) > 5.0 * self.error).all())


@dataclass(frozen=True)
class MarkerFlow:
    """What was measured; lengths in radii of the marker field, by the labels' own units.

    Attributes
    ----------
    positions : (n, markers, 2) tracked markers, px; NaN where one was not found
    labels : (n, 6)
    rest : (markers, 2) px
    center : (2,), radius : float, of the marker field, px
    deeper : float
        Variety of the images at the largest over that at the least depth: over 1 where depth grows with z.
    shear : Measured (2, 2) motion (column, row) of inner markers by x and y
    tilt : Measured (2, 2) the same by -beta and alpha
    spread : Measured () divergence k of the inner markers, halved
    turn : Measured () rotation of inner markers in deep contacts, from column to row, rad by gamma
    found : share of the markers that could be followed
    """

    positions: Array
    labels: Array
    rest: Array
    center: Array
    radius: float
    deeper: float
    shear: Measured
    tilt: Measured
    spread: Measured
    turn: Measured
    found: float


def measure(
    folder: TactileFolder,
    settings: FlowSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> MarkerFlow:
    """Follow the markers of some images of a data set and measure how they move with the labels.

    Raises `FlowError` if there are too few images, or too few markers in them.
    """
    settings = settings or FlowSettings()
    return follow(folder, *look(folder, settings, progress), settings)


def follow(
    folder: TactileFolder, chosen: NDArray[np.int64], images: list[Image], settings: FlowSettings
) -> MarkerFlow:
    """`measure` with the samples that `look` has chosen."""
    labels = folder.euler_mm_deg[chosen]
    deeper = variety_with_depth(images, labels)
    order = np.argsort(labels[:, 2] if deeper >= 1.0 else -labels[:, 2])
    detection = DetectionSettings(median=5 if min(images[0].shape) >= _FINE_SIDE else 0)
    blobs = [detect(image, detection).centers for image in images]
    rest = _rest(folder, blobs, labels, order, detection)
    return flow_of(track(blobs, labels, order, rest), labels, rest, deeper, settings)


def flow_of(
    positions: Array, labels: Array, rest: Array, deeper: float, settings: FlowSettings | None = None
) -> MarkerFlow:
    """The flow of markers that are followed already; see `MarkerFlow` for the arguments."""
    settings = settings or FlowSettings()
    order = np.argsort(labels[:, 2] if deeper >= 1.0 else -labels[:, 2])
    center = (rest.max(axis=0) + rest.min(axis=0)) / 2
    radius = float(np.percentile(np.linalg.norm(rest - center, axis=1), 95))
    maps = _maps((positions - center) / radius, (rest - center) / radius, labels, order, settings)
    found = float(np.isfinite(positions[..., 0]).mean())
    return MarkerFlow(positions, labels, rest, center, radius, deeper, *maps, found)


def look(
    folder: TactileFolder, settings: FlowSettings, progress: Callable[[int, int], None] | None = None
) -> tuple[NDArray[np.int64], list[Image]]:
    """Indices and images of samples at random, binary or the gray crops; `FlowError` with too few.

    Unreadable ones are left out: they are reported elsewhere.
    """
    rng = np.random.default_rng(settings.seed)
    index = np.sort(rng.permutation(len(folder))[: settings.samples])
    preprocessor = None if folder.processed else Preprocessor(folder.preprocessing)
    kept, images = [], []
    for count, i in enumerate(index.tolist()):
        try:
            image = folder.image(i)
            images.append(image if preprocessor is None else preprocessor.cropped(image))
            kept.append(i)
        except ImageError:
            continue
        if progress is not None:
            progress(count + 1, len(index))
    if len(kept) < _FEWEST:
        raise FlowError(f"{len(kept)} readable images: at least {_FEWEST} are needed to follow markers")
    return np.array(kept), images


def variety_with_depth(images: list[Image], labels: Array) -> float:
    """Deep contacts differ from each other more than shallow ones: ratio of that at both ends of z."""
    order = np.argsort(labels[:, 2])
    count = max(5, round(_END_SHARE * len(order)))

    def variety(chosen: NDArray[np.int64]) -> float:
        small = [cv2.resize(images[i], (_SMALL, _SMALL), interpolation=cv2.INTER_AREA) for i in chosen]
        smooth = np.array([cv2.GaussianBlur(image, (0, 0), 1.5) for image in small], dtype=np.float64)
        return float(smooth.std(axis=0).mean())

    return variety(order[-count:]) / max(variety(order[:count]), 1e-9)


def _rest(
    folder: TactileFolder, blobs: list[Array], labels: Array, order: NDArray[np.int64],
    detection: DetectionSettings,
) -> Array:  # fmt: skip
    """Markers of the image without contact, else of the shallow contact that is sheared the least."""
    shallow = order[: max(3, len(order) // 10)]
    size = np.maximum(np.abs(labels).max(axis=0), 1e-12)
    active = np.linalg.norm((labels / size)[:, [0, 1, 3, 4, 5]], axis=1)
    rest = blobs[int(shallow[np.argmin(active[shallow])])]
    reference = folder.reference()
    if reference is not None and folder.processed and reference.shape == folder.preprocessing.crop_shape:
        rest = detect(reference, detection).centers
    if len(rest) < _LEAST_SEEN:
        raise FlowError(
            f"{len(rest)} markers found in an image without shear: at least {_LEAST_SEEN} are needed"
        )
    return rest


def _maps(
    positions: Array, rest: Array, labels: Array, order: NDArray[np.int64], settings: FlowSettings
) -> tuple[Measured, Measured, Measured, Measured]:
    """Shear, tilt, spread and turn with errors from drawing samples again (bootstrap)."""
    inner = np.linalg.norm(rest, axis=1) < settings.inner
    depth_rank = np.empty(len(order))
    depth_rank[order] = np.arange(len(order)) / len(order)
    rng = np.random.default_rng(settings.seed + 1)
    draws = [_once(positions, rest, labels, depth_rank, inner, settings, np.ones(len(labels)))]
    for _ in range(BOOTSTRAPS):
        weights = rng.multinomial(len(labels), np.full(len(labels), 1.0 / len(labels))).astype(float)
        draws.append(_once(positions, rest, labels, depth_rank, inner, settings, weights))
    parts = []
    for values in zip(*draws, strict=True):
        stack = np.array(values, dtype=np.float64)
        parts.append(Measured(stack[0], np.asarray(stack[1:].std(axis=0))))
    shear, tilt, spread, turn = parts
    return shear, tilt, spread, turn


def _once(
    positions: Array, rest: Array, labels: Array, rank: Array, inner: NDArray[np.bool_],
    settings: FlowSettings, weights: Array,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Shear (2, 2), tilt (2, 2), spread () and turn () for one weighting of the samples."""
    x, y, _, alpha, beta, gamma = labels.T
    basis = np.stack([np.ones_like(x), rank - 0.5, x, y, -beta, alpha, gamma], axis=1)
    half = regressions(basis, positions, weights * (rank > 0.3), markers=inner)
    used = inner & np.isfinite(half[:, 0, 0])
    if used.sum() < _LEAST_MARKERS:
        raise FlowError(
            f"{used.sum()} markers in the middle could be followed, must be {_LEAST_MARKERS} or more: "
            "take more samples"
        )
    shear, tilt = half[used, 2:4].mean(axis=0).T, half[used, 4:6].mean(axis=0).T
    outward = np.column_stack([rest[used], np.ones(used.sum())])
    gradient = np.linalg.lstsq(outward, half[used, 0] - rest[used], rcond=None)[0]
    spread = np.array((gradient[0, 0] + gradient[1, 1]) / 2)
    # rotation shows in deep contacts only, under the larger motions by shear and tilt; in their very middle,
    # where markers are lost or mistaken most, it is not looked for
    bent = [v * (rank - 0.8) for v in (x, y, -beta, alpha)]
    bent += [p * q for p, q in itertools.combinations_with_replacement((x, y, alpha, beta), 2)]
    distance = np.linalg.norm(rest, axis=1)
    middle = (distance >= settings.ring[0]) & (distance < settings.ring[1])
    basis = np.column_stack([basis, *bent])
    deep = regressions(basis, positions, weights * (rank > settings.deep), markers=middle)
    used = middle & np.isfinite(deep[:, 0, 0])
    r, moved = rest[used], deep[used, 6]
    turn = np.array(np.sum(r[:, 0] * moved[:, 1] - r[:, 1] * moved[:, 0]) / max(np.sum(r**2), 1e-12))
    if used.sum() < _LEAST_MARKERS:
        turn = np.array(np.nan)
    return shear, tilt, spread, turn


def regressions(
    basis: Array,
    positions: Array,
    weights: NDArray,
    least: int = _LEAST_SEEN,
    markers: NDArray[np.bool_] | None = None,
) -> Array:
    """Weights (markers, basis, 2) by which markers follow a basis; NaN for those that are not asked for.

    Parameters
    ----------
    basis : (n, basis)
    positions : (n, markers, 2); NaN where one was not found
    weights : (n,) of the samples
    least : samples of positive weight in which a marker must have been seen; NaN for others, too
    """
    out = np.full((positions.shape[1], basis.shape[1], 2), np.nan)
    scale = np.maximum(np.abs(basis).max(axis=0), 1e-12)
    for marker in range(positions.shape[1]) if markers is None else np.flatnonzero(markers):
        w = weights * np.isfinite(positions[:, marker, 0])
        seen = w > 0
        if seen.sum() < least:
            continue
        a = basis[seen] / scale * np.sqrt(w[seen])[:, None]
        b = positions[seen, marker] * np.sqrt(w[seen])[:, None]
        out[marker] = np.linalg.lstsq(a, b, rcond=None)[0] / scale[:, None]
    return out
