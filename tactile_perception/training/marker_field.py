"""The displacement field of an image's markers, in polynomials on the disc where they rest.

Zernike's polynomials: orthonormal on a disc, few where the field is smooth, and closed under turns and
reflections, so that the field of a turned image is a matrix times that of the image.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_perception.datasets.dataset import DatasetError, open_folder
from tactile_perception.datasets.folder import TactileFolder
from tactile_perception.markers.labelled import Progress, track

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

#: Part of the markers that must have been found for an image to tell its field.
LEAST_FOUND = 0.9
#: Part of the images whose field must be known.
LEAST_KNOWN = 0.5
_AT_REST = 0.05  # part of the contacts that are shallow
_MARGIN = 1.02  # of the disc around the outermost marker


def polynomials(points: Array, order: int) -> Array:
    """Zernike's polynomials (P, F) up to a radial order at points (P, 2) of the unit disc.

    Outside, where they would grow without bounds, they are as on its rim.
    """
    radius = np.minimum(np.hypot(*points.T), 1.0)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    columns = []
    for n in range(order + 1):
        for m in range(n % 2, n + 1, 2):
            radial = np.sqrt(n + 1.0) * _radial(n, m, radius)
            if m == 0:
                columns.append(radial)
            else:
                columns += [np.sqrt(2.0) * radial * np.cos(m * azimuth)]
                columns += [np.sqrt(2.0) * radial * np.sin(m * azimuth)]
    return np.stack(columns, axis=1)


def _radial(n: int, m: int, radius: Array) -> Array:
    total = np.zeros_like(radius)
    for k in range((n - m) // 2 + 1):
        below = factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k)
        total += (-1) ** k * factorial(n - k) / below * radius ** (n - 2 * k)
    return total


def mapped(order: int, linear: Array) -> Array:
    """(2 F, 2 F): what a turn or reflection (2, 2) of the image makes of a field's numbers."""
    rng = np.random.default_rng(0)
    radius, azimuth = np.sqrt(rng.random(1000)), 2.0 * np.pi * rng.random(1000)
    points = radius[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    before, after = polynomials(points, order), polynomials(points @ linear, order)
    return np.kron(np.linalg.lstsq(before, after, rcond=None)[0], linear)


def all_mapped(order: int, maps: Array) -> Array:
    """(n, 2 F, 2 F): `mapped` by each of maps (n, 2, 2)."""
    return np.array([mapped(order, linear) for linear in maps])


@dataclass(frozen=True)
class MarkerFields:
    """Fields of a data set's images.

    Attributes
    ----------
    center, radius : of the disc, (2,) and a number, in pixels of the crop
    values : (N, F, 2) displacements along columns and rows, pixels of the crop; NaN where it is not known
    """

    center: Array
    radius: float
    values: NDArray[np.float32]

    @classmethod
    def of(
        cls,
        folder: Path,
        origin: tuple[float, ...],
        order: int,
        names: list[str],
        progress: Progress | None = None,
    ) -> MarkerFields:
        """Follow the markers of a folder's images; `DatasetError` where that does not succeed.

        Where a simulator has told where they are, that is taken. Of simulated sensors that took turns each
        has its own disc, and all together their mean. `origin`: of the crop in the camera image.
        """
        source = open_folder(folder)
        row_of = {name: row for row, name in enumerate(source.names)}
        rows = np.array([row_of[name] for name in names])
        sensor = source.sensor[rows]
        sensors = [np.flatnonzero(sensor == k) for k in np.unique(sensor)]
        done, told = np.cumsum([0, *map(len, sensors)]), _told(source, rows)
        values = np.full((len(names), (order + 1) * (order + 2) // 2, 2), np.nan, np.float32)
        discs = []
        for number, chosen in enumerate(sensors):
            own = rows[chosen]
            try:
                rest, positions = (
                    _followed(source, own, _part(progress, done, number))
                    if told is None
                    else _with_rest(told[chosen], source.euler_mm_deg[own, 2])
                )
            except ValueError as error:
                raise DatasetError(f"network.field_order = {order}: {error}") from error
            center = rest.mean(axis=0)
            radius = _MARGIN * float(np.linalg.norm(rest - center, axis=1).max())
            discs.append((*(center - origin), radius))
            values[chosen] = _fitted(positions - rest, polynomials((rest - center) / radius, order))
        *middle, radius = np.mean(discs, axis=0)
        fields = cls(np.array(middle), float(radius), values)
        if fields.known.mean() < LEAST_KNOWN:
            raise DatasetError(
                f"network.field_order = {order}: {folder}: the markers could be followed in "
                f"{fields.known.sum()} of {len(names)} images only, needs half of them. Set it to 0, for a "
                "network that does without"
            )
        return fields

    def among(self, count: int, rows: Rows) -> MarkerFields:
        """As rows of so many samples, the others of which are not known."""
        values = np.full((count, *self.values.shape[1:]), np.nan, np.float32)
        values[rows] = self.values
        return MarkerFields(self.center, self.radius, values)

    @property
    def known(self) -> NDArray[np.bool_]:
        """(N,)"""
        return np.asarray(np.isfinite(self.values[:, 0, 0]))

    def modes(self, order: int, copies: Array) -> tuple[Array, Array]:
        """Mean (2 F,) and modes (2 F, 2 F) of the fields of images mapped by `copies` (n, 2, 2).

        A field's numbers are mean + modes @ q, with q along the fields' principal axes. Each of q is divided
        by the root of its deviation: small parts of a field, that tell the twist, weigh more than by their
        pixels, and less than if all had the same deviation.
        """
        values = self.values[self.known].reshape(-1, 2 * self.values.shape[1]).astype(np.float64)
        maps = all_mapped(order, copies)
        mean = maps.mean(axis=0) @ values.mean(axis=0)
        second = (values - mean).T @ (values - mean) / len(values)
        variance, axes = np.linalg.eigh((maps @ second @ maps.transpose(0, 2, 1)).mean(axis=0))
        deviation = np.sqrt(np.maximum(variance[::-1], 1e-6))
        return mean, axes[:, ::-1] * np.sqrt(deviation * deviation.mean())


def _followed(source: TactileFolder, rows: Rows, progress: Progress | None) -> tuple[Array, Array]:
    """Of one sensor's images: markers at rest (m, 2) and in each (n, m, 2), in pixels of the camera image."""
    tracked = track(source, rows, progress)
    return tracked.rest, tracked.positions


def _told(source: TactileFolder, rows: Rows) -> Array | None:
    """Markers (n, m, 2) as a simulator knows them; None where it does not tell."""
    found = [source.markers(row) for row in rows.tolist()]
    return None if found[0] is None else np.array(found)


def _with_rest(positions: Array, depth: Array) -> tuple[Array, Array]:
    """As `_followed`: markers rest where they are in the middle of the shallowest contacts."""
    return np.median(positions[depth <= np.quantile(depth, _AT_REST)], axis=0), positions


def _fitted(moved: Array, basis: Array) -> NDArray[np.float32]:
    """Polynomials' numbers (n, F, 2) of displacements (n, m, 2); NaN where too few markers were found."""
    values = np.full((len(moved), basis.shape[1], 2), np.nan, np.float32)
    for image, displacement in enumerate(moved):
        seen = np.isfinite(displacement[:, 0])
        if seen.mean() >= LEAST_FOUND:
            values[image] = np.linalg.lstsq(basis[seen], displacement[seen], rcond=None)[0]
    return values


def _part(progress: Progress | None, done: Rows, number: int) -> Progress | None:
    """Progress over all sensors, for the tracking of one."""
    if progress is None:
        return None
    share, before, tell = done[number + 1] - done[number], done[number], progress
    return lambda so_far, total: tell(int(total * before / share) + so_far, int(total * done[-1] / share))
