"""Markers in tactile images: where they are, and how their density differs from the state without contact.

Two steps of the paper's figure of marker densities (`fig:marker_density_images`), each a call::

    reference = detect(image_without_contact)
    change = density_change(detect(image), reference, shape=image.shape)

`detect` takes camera images as well as pre-processed (binary) ones. `density_change` is the difference of
two kernel densities with Gaussian kernels at the markers, as wide as the mean distance between adjacent ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tactile_base.settings import SettingError, Settings, setting
from tactile_perception.estimating.image import Image, ImageError, check_image

Array = NDArray[np.float64]
_LARGEST_SHARE = 0.02  # of the image, from which a blob is no marker


@dataclass(frozen=True)
class DetectionSettings(Settings):
    """What counts as a marker; areas are relative to the median blob, so that they suit any optics."""

    median: int = setting(5, unit="px", choices=(0, 3, 5), doc="side of the median filter; 0: none")
    neighborhood: int = setting(
        61, unit="px", lower=3, upper=1001, doc="side of the square whose mean is the ground, odd"
    )
    contrast: float = setting(
        0.25, lower=0.01, upper=0.99,
        doc="over the ground, relative to that of the brightest markers, from which a pixel is white",
    )  # fmt: skip
    min_contrast: float = setting(8.0, lower=0.0, upper=255.0, doc="gray levels over the ground, at least")
    min_area: float = setting(
        0.3, lower=0.0, upper=1.0, doc="smallest blob that is a marker, in median blobs"
    )
    max_area: float = setting(
        8.0, lower=1.0, upper=1000.0,
        doc="largest blob that is split into markers, in median blobs; larger is no marker",
    )  # fmt: skip
    split_area: float = setting(
        1.55, lower=1.0, upper=100.0, doc="blobs from here on are merged markers, in median blobs"
    )
    fill: float = setting(
        0.55, lower=0.0, upper=1.0, doc="least part of its enclosing ellipse that a single marker fills"
    )
    neighbors: int = setting(
        3, lower=0, upper=6,
        doc="other markers within twice the usual distance; what has fewer is a reflection or a speck",
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.neighborhood % 2 == 0:
            raise SettingError(f"neighborhood = {self.neighborhood}: must be odd")


@dataclass(frozen=True)
class DetectedMarkers:
    """Markers of one image.

    Attributes
    ----------
    centers : (n, 2) px, column and row, sub-pixel; the middle of the first pixel is (0, 0)
    areas : (n,) px^2, of the markers' blobs; of a merged blob the equal parts
    merged : (n,) bool, whether the marker was split off a blob of several, so that its place is less certain
    """

    centers: Array
    areas: Array
    merged: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.centers)

    def spacing(self) -> float:
        """Mean distance of a marker to the one next to it, px; `ImageError` with fewer than two markers."""
        if len(self) < 2:
            raise ImageError(
                f"{len(self)} markers found: at least two are needed for the distance between them"
            )
        distance, _ = cKDTree(self.centers).query(self.centers, k=2)
        return float(distance[:, 1].mean())


@dataclass(frozen=True)
class DensityChange:
    """Difference of two marker densities on a grid.

    Attributes
    ----------
    values : (rows, columns)
        Markers per squared spacing, less those of the reference: negative where markers have parted.
    columns, rows : (columns,), (rows,) px, where in the image the grid's values stand
    spacing : px, kernel width (standard deviation): mean distance between adjacent markers of the reference
    """

    values: Array
    columns: Array
    rows: Array
    spacing: float


def detect(image: Image, settings: DetectionSettings | None = None) -> DetectedMarkers:
    """Markers of a camera image or of a pre-processed (binary) one.

    Of a camera image the centers are weighted by brightness; of a binary image they are the blobs' centroids.

    Raises `ImageError` if the image is not a gray image of 8 bits.

    Parameters
    ----------
    image : uint8 (rows, columns)
        Bright markers on a dark ground. With no other values than 0 and 255 it is taken as pre-processed.
    """
    settings = settings or DetectionSettings()
    gray = np.ascontiguousarray(check_image(image, None, "image with markers"))
    smooth = np.asarray(cv2.medianBlur(gray, settings.median) if settings.median else gray, np.uint8)
    white, weight = (smooth, None) if is_binary(gray) else _bright(smooth, settings)
    found = cv2.connectedComponentsWithStats(white, connectivity=4, ltype=cv2.CV_32S)
    labels, stats = (np.asarray(part, np.int32) for part in found[1:3])
    moments = _moments(labels, stats[:, cv2.CC_STAT_AREA], np.asarray(found[3], float), weight)
    typical = _typical_area(stats[1:, cv2.CC_STAT_AREA], gray.size)
    return _without_strays(_collect(labels, stats, moments, typical, settings), settings.neighbors)


def redrawn(markers: DetectedMarkers, shape: tuple[int, int], radius: float) -> Image:
    """White discs of one size (radius, px) on black where the markers are: uint8 (rows, columns).

    What is left of an image when all that differs between sensors, but for the markers' places, is taken out.
    """
    image = np.zeros(shape, np.uint8)
    for column, row in np.rint(16 * markers.centers).astype(int):
        cv2.circle(image, (int(column), int(row)), round(16 * radius), 255, -1, cv2.LINE_AA, shift=4)
    return image


def is_binary(image: Image) -> bool:
    """Whether an image holds nothing but 0 and 255."""
    histogram = cv2.calcHist([image], [0], None, [256], [0, 256])
    return bool(histogram[1:255].sum() == 0)


def density(centers: Array, columns: Array, rows: Array, width: float) -> Array:
    """Kernel density (rows, columns), markers per px^2; Gaussian kernels of standard deviation `width`."""
    # a Gaussian is a product over the two axes, so the sum over markers is a product of two matrices
    across = np.exp(-0.5 * ((columns[:, None] - centers[None, :, 0]) / width) ** 2)
    along = np.exp(-0.5 * ((rows[:, None] - centers[None, :, 1]) / width) ** 2)
    return np.asarray(along @ across.T / (2 * np.pi * width**2))


def density_change(
    markers: DetectedMarkers, reference: DetectedMarkers, shape: tuple[int, int], step: int = 4
) -> DensityChange:
    """Marker density against that of the state without contact, as in the paper's figure.

    Raises `ImageError` if the reference holds fewer than two markers.

    Parameters
    ----------
    markers, reference
        Of the image, and of one without contact; both of the same crop.
    shape : (rows, columns) px, of the images
    step : px, of the grid on which the density is computed
    """
    spacing = reference.spacing()
    rows, columns = (np.arange((step - 1) / 2, size, step) for size in shape)
    values = density(markers.centers, columns, rows, spacing) - density(
        reference.centers, columns, rows, spacing
    )
    return DensityChange(values * spacing**2, columns, rows, spacing)


def _bright(smooth: Image, settings: DetectionSettings) -> tuple[Image, Image]:
    """What is brighter than its neighborhood (uint8), and by how much (the weights of the centers)."""
    side = settings.neighborhood
    ground = cv2.boxFilter(smooth, cv2.CV_8U, (side, side), borderType=cv2.BORDER_REPLICATE)
    over = cv2.subtract(smooth, ground)
    histogram = np.cumsum(cv2.calcHist([over], [0], None, [256], [0, 256]))
    brightest = float(np.searchsorted(histogram, 0.99 * histogram[-1]))
    level = max(settings.min_contrast, settings.contrast * brightest)
    white = cv2.threshold(over, level, 255, cv2.THRESH_BINARY)[1]
    return np.asarray(white, np.uint8), np.asarray(over, np.uint8)


def _moments(
    labels: NDArray[np.int32], areas: NDArray[np.int32], centroids: Array, weight: Image | None
) -> Array:
    """Weighted center, unweighted second moments (count, 5): column, row, cc, cr, rr; first: the ground."""
    place = np.flatnonzero(labels)
    blob = labels.ravel()[place]
    row, column = np.divmod(place.astype(np.int32), np.int32(labels.shape[1]))
    area = np.maximum(areas, 1).astype(float)

    def total(values: NDArray) -> Array:
        return np.asarray(np.bincount(blob, values, minlength=len(areas)), float)

    # about the centroids, where single precision is enough
    middle = centroids.astype(np.float32)[blob]
    c, r = column - middle[:, 0], row - middle[:, 1]
    second = np.stack([total(c * c), total(c * r), total(r * r)], axis=1) / area[:, None]
    if weight is None:
        return np.concatenate([centroids, second], axis=1)
    mass = weight.ravel()[place].astype(np.float32)
    heavy = np.maximum(total(mass), 1e-12)[:, None]
    return np.concatenate(
        [centroids + np.stack([total(mass * c), total(mass * r)], axis=1) / heavy, second], axis=1
    )


def _typical_area(areas: NDArray[np.int32], image_area: int) -> float:
    """Area of the blob that holds the middle white pixel: specks and merged blobs hardly move it."""
    ordered = np.sort(areas[areas < _LARGEST_SHARE * image_area])
    if not len(ordered):
        return 0.0
    share = np.cumsum(ordered) / ordered.sum()
    return float(ordered[np.searchsorted(share, 0.4)])


def _collect(
    labels: NDArray[np.int32], stats: NDArray[np.int32], moments: Array, typical: float,
    settings: DetectionSettings,
) -> DetectedMarkers:  # fmt: skip
    """Single markers as they are, merged ones split, the rest left out."""
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    if not typical:
        return DetectedMarkers(np.empty((0, 2)), np.empty(0), np.empty(0, dtype=bool))
    usable = (area >= settings.min_area * typical) & (area <= settings.max_area * typical)
    usable[0] = False
    merged = usable & (area >= settings.split_area * typical)
    filled = area >= settings.fill * _ellipse_area(moments[:, 2:])
    single = usable & ~merged & filled & ~_too_long(moments[:, 2:])
    centers, areas = [moments[single, :2]], [area[single]]
    for blob in np.flatnonzero(merged):
        parts = _split(labels, stats[blob], int(blob), typical)
        if parts is not None:
            centers.append(parts)
            areas.append(np.full(len(parts), area[blob] / len(parts)))
    count = int(single.sum())
    all_areas = np.concatenate(areas)
    return DetectedMarkers(np.concatenate(centers), all_areas, np.arange(len(all_areas)) >= count)


def _without_strays(markers: DetectedMarkers, neighbors: int) -> DetectedMarkers:
    """Markers that stand in the field of markers: with enough others near them."""
    if len(markers) <= neighbors or neighbors == 0:
        return markers
    distance, _ = cKDTree(markers.centers).query(markers.centers, k=neighbors + 1)
    near = distance[:, neighbors] < 2.0 * np.median(distance[:, 1])
    return DetectedMarkers(markers.centers[near], markers.areas[near], markers.merged[near])


def _ellipse_area(second: Array) -> Array:
    """Area of the ellipse with these second moments (n, 3), plus the pixels' own extent."""
    determinant = (second[:, 0] + 1 / 12) * (second[:, 2] + 1 / 12) - second[:, 1] ** 2
    return np.asarray(4 * np.pi * np.sqrt(np.maximum(determinant, 0.0)))


def _too_long(second: Array, ratio: float = 3.0) -> NDArray[np.bool_]:
    """Whether a blob is more than `ratio` times as long as wide: reflections and the rim, not markers."""
    middle = (second[:, 0] + second[:, 2]) / 2 + 1 / 12
    half = np.hypot((second[:, 0] - second[:, 2]) / 2, second[:, 1])
    return np.asarray(middle + half > ratio**2 * np.maximum(middle - half, 1e-12))


def _split(labels: NDArray[np.int32], stat: NDArray[np.int32], blob: int, typical: float) -> Array | None:
    """Centers (k, 2) of the markers in one blob; None for a blob that is not made of markers.

    As many as it has hills in the distance to its edge; where hills have run into each other, as many as its
    area holds. Their pixels are shared out by the nearest center (k-means from the hills).
    """
    left, top, wide, high = stat[:4]
    inside = np.zeros((high + 2, wide + 2), np.uint8)
    inside[1:-1, 1:-1] = labels[top : top + high, left : left + wide] == blob
    depth = cv2.distanceTransform(inside, cv2.DIST_L2, 5)
    radius = np.sqrt(typical / np.pi)
    if depth.max() < 0.6 * radius or depth.max() > 1.8 * radius:
        return None  # thinner or thicker than markers side by side
    points = np.argwhere(inside)[:, ::-1].astype(float)
    hills = _hills(depth, radius)
    wanted = max(2, round(len(points) / typical))
    if len(hills) < 2:
        hills = _along_axis(points, wanted)
    centers = _share_out(points, hills)
    return centers + np.array([left - 1.0, top - 1.0])


def _hills(depth: NDArray, radius: float) -> Array:
    """Summits (k, 2) of the distance to the edge, at least a marker's radius apart."""
    smooth = cv2.GaussianBlur(depth, (0, 0), 0.35 * radius)
    side = 2 * int(np.ceil(0.9 * radius)) + 1
    top = (smooth >= cv2.dilate(smooth, np.ones((side, side), np.uint8))) & (smooth > 0.5 * smooth.max())
    _, _, _, centers = cv2.connectedComponentsWithStats(top.astype(np.uint8))
    return np.asarray(centers[1:])


def _along_axis(points: Array, count: int) -> Array:
    """`count` places spread over the longest axis of a set of points."""
    middle = points.mean(axis=0)
    axis = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    along = (points - middle) @ axis
    return middle + np.quantile(along, (np.arange(count) + 0.5) / count)[:, None] * axis


def _share_out(points: Array, centers: Array, rounds: int = 8) -> Array:
    """k-means from these centers; a center that gets no point is left out."""
    for _ in range(rounds):
        nearest = ((points[:, None] - centers[None]) ** 2).sum(axis=2).argmin(axis=1)
        held = np.bincount(nearest, minlength=len(centers))
        sums = np.stack([np.bincount(nearest, points[:, k], len(centers)) for k in range(2)], axis=1)
        centers = sums[held > 0] / held[held > 0, None]
    return centers
