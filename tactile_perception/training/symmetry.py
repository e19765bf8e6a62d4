"""The symmetry of the marker pattern: turning or mirroring an image, and its label with it.

The TacTip's 331 markers lie in rings of 1 + 6 + 12 + ... + 60, so that the sensor looks the same after a
sixth of a turn about its axis, and in a mirror along that axis. An image turned so is the image of a contact
turned likewise: with S the turn about the axis, or the reflection, X' = S X S^-1, which in exponential
coordinates is exactly xi' = Ad_S xi. Where the contact has a direction of its own, as on an edge, its frame
goes along, X_sf' = S X_sf (and for a reflection the frame's x-axis is reversed, as frames are right-handed).
Were the axis the z axis of {s}, that would turn rho and phi; in practice the labels' {s} stands a few
millimeters beside the markers' axis, and the axis is learned with the network's weights.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from torch import Tensor, nn

from tactile_perception.estimating.image import Image

Array = NDArray[np.float64]
Pattern = NDArray[np.float32]

#: Blur of the mean image before images are compared, in pixels; more would wipe small markers out.
_BLUR = 1.0
#: And of what is taken from them, for contacts and shades are wider than markers.
_SHADES = 6.0
#: The shallowest samples, whose mean shows the markers nearly at rest: a part of all, or so many.
_SHALLOW, _FEW = 0.03, (10, 20)
#: Percentile of the levels above the mean from which on all is one: a lamp's glare is none of the pattern.
_BRIGHT = 80.0
#: Directions that are tried for a mirror.
_DIRECTIONS = 60
#: Side, in pixels, at which images tell the direction of a mirror, and how firmly their map is held at 0.
_LOOK, _RIDGE = 12, 0.1


def turn(angle: float) -> Array:
    """(2, 2) rotation from x to y by `angle` (rad)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def reflection(direction: float) -> Array:
    """(2, 2) mirror along the line in this direction (rad from x to y)."""
    c, s = np.cos(2.0 * direction), np.sin(2.0 * direction)
    return np.array([[c, s], [s, -c]])


class SymmetryAxis(nn.Module):
    """The axis about which labels are turned: a trainable offset and tilt in {s}, and a mirror through it.

    Attributes
    ----------
    values : (4,) offset x, y in mm and tilt about x, y in units of 1/50 rad, of like effect on the labels;
        with a mirror (5,), with its line's direction in the same unit
    """

    UNIT = 0.02  # rad

    def __init__(
        self,
        start: tuple[float, ...],
        order: int,
        sense: int,
        mirror: float | None = None,
        directed: bool = False,
    ) -> None:
        """Where it starts from, and the symmetry.

        Parameters
        ----------
        start : x, y in mm, tilt about x, y in rad
        order, sense : turns are multiples of sense / order of a circle
        mirror : direction (rad) in {s} of the line that all are mirrored at, too; None: they are not
        directed : labels are Euler contact poses whose frame goes along with the turn, else xi_sf
        """
        super().__init__()
        self.directed, self.mirrored = directed, mirror is not None
        numbers = torch.tensor([*start, *([] if mirror is None else [mirror])])
        units = torch.tensor([1.0, 1.0, *[self.UNIT] * (len(numbers) - 2)])
        self.values = nn.Parameter(numbers / units)
        self.units: Tensor
        self.register_buffer("units", units)
        turns = torch.eye(3).repeat(order, 1, 1)
        for k in range(order):
            turns[k, :2, :2] = torch.tensor(turn(sense * 2.0 * np.pi * k / order), dtype=torch.float32)
        self.turns: Tensor
        self.register_buffer("turns", turns)

    def parameters_of_axis(self) -> tuple[float, ...]:
        """x, y in mm, tilt about x, y in rad, and the mirror's direction in rad where there is one."""
        return tuple((self.values * self.units).tolist())

    def forward(self, labels: Tensor, turns: Tensor) -> Tensor:
        """Labels (N, 6 or more) in mm, rad and N of the contacts turned `turns` (N,) times; exact for 0.

        From the symmetry's order on they are mirrored after the turn. Forces turn with the sensor's axes.
        """
        linear, offset = self._isometries()
        linear, offset = linear[turns], offset[turns]
        pose = _euler_moved if self.directed else _twists_moved
        moved = [pose(labels[:, :6], linear, offset)]
        if labels.shape[1] > 6:
            moved.append(torch.einsum("nij,nj->ni", linear, labels[:, 6:]))
        return torch.where(turns[:, None] == 0, labels, torch.cat(moved, dim=1))

    def _isometries(self) -> tuple[Tensor, Tensor]:
        """S for each number of turns: linear parts (2 order, 3, 3), or (order, 3, 3), and offsets in mm."""
        x, y, *angles = (self.values * self.units).unbind()
        zero = torch.zeros_like(x)
        to_axis = torch.linalg.matrix_exp(_hat(torch.stack([angles[0], angles[1], zero])))
        about_z = self.turns
        if self.mirrored:
            c, s, one = torch.cos(2.0 * angles[2]), torch.sin(2.0 * angles[2]), torch.ones_like(x)
            mirror = torch.stack([c, s, zero, s, -c, zero, zero, zero, one]).reshape(3, 3)
            about_z = torch.cat([about_z, mirror @ about_z])
        linear = to_axis @ about_z @ to_axis.mT
        point = torch.stack([x, y, zero])
        return linear, point - linear @ point


def _twists_moved(labels: Tensor, linear: Tensor, offset: Tensor) -> Tensor:
    """xi_sf (N, 6) of S X_sf S^-1, exactly, S of these parts (N, 3, 3) and (N, 3)."""
    sense = torch.linalg.det(linear)[:, None]
    phi = sense * torch.einsum("nij,nj->ni", linear, labels[:, 3:])
    rho = torch.einsum("nij,nj->ni", linear, labels[:, :3]) + torch.linalg.cross(offset, phi)
    return torch.cat([rho, phi], dim=1)


def _euler_moved(labels: Tensor, linear: Tensor, offset: Tensor) -> Tensor:
    """Euler contact poses (N, 6) whose X_sf becomes S X_sf; what is NaN, not labelled, counts as 0."""
    x, y, z, alpha, beta, gamma = torch.nan_to_num(labels).unbind(dim=1)
    (sa, sb, sg), (ca, cb, cg) = (
        [trigonometric(angle) for angle in (alpha, beta, gamma)] for trigonometric in (torch.sin, torch.cos)
    )
    rows = (
        (cg * cb, cg * sb * sa - sg * ca, cg * sb * ca + sg * sa),
        (sg * cb, sg * sb * sa + cg * ca, sg * sb * ca - cg * sa),
        (-sb, cb * sa, cb * ca),
    )
    R_fs = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
    turned = R_fs @ linear.mT  # X_fs S^-1
    place = torch.stack([x, y, z], dim=1) - torch.einsum("nij,nj->ni", turned, offset)
    frame = torch.ones_like(place)
    frame[:, 0] = torch.linalg.det(linear).detach().sign()
    place, turned = frame * place, frame[:, :, None] * turned
    angles = (
        torch.atan2(turned[:, 2, 1], turned[:, 2, 2]),
        -torch.asin(turned[:, 2, 0].clamp(-1.0, 1.0)),
        torch.atan2(turned[:, 1, 0], turned[:, 0, 0]),
    )
    moved = torch.cat([place, torch.stack(angles, dim=1)], dim=1)
    return torch.where(labels.isnan(), labels, moved)


def _hat(vector: Tensor) -> Tensor:
    """(3,) -> its cross-product matrix (3, 3)."""
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


class CropGeometry:
    """Between pixels of the crop, `crop_shape` (rows, columns), and of a square copy of `side` pixels."""

    def __init__(self, crop_shape: tuple[int, int], side: int) -> None:
        rows, columns = crop_shape
        self.side = side
        self._scale = np.array([side / columns, side / rows])

    def to_square(self, points: Array) -> Array:
        """Crop pixels (..., 2) -> pixels of the square; pixel centers are whole numbers in both."""
        return (points + 0.5) * self._scale - 0.5

    def to_crop(self, points: Array) -> Array:
        """The reverse."""
        return (points + 0.5) / self._scale - 0.5

    def inverse_map(self, linear: Array, center: Array, shift: Array) -> Array:
        """(2, 3) map from result to source pixels of the square, as `cv2.WARP_INVERSE_MAP` wants it.

        In the crop the image is mapped by `linear` (2, 2) about `center` and then moved by `shift`.
        """
        corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        source = (self.to_crop(corners) - center - shift) @ np.linalg.inv(linear).T + center
        mapped = self.to_square(source)
        return np.column_stack([mapped[1] - mapped[0], mapped[2] - mapped[0], mapped[0]])

    def disk(self, center: Array, radius: float) -> NDArray[np.bool_]:
        """(side, side): which pixels of the square lie in this disk of the crop."""
        columns, rows = np.meshgrid(np.arange(self.side), np.arange(self.side))
        points = self.to_crop(np.stack([columns, rows], axis=-1).astype(np.float64))
        return np.asarray(np.linalg.norm(points - center, axis=-1) < radius)


def find_center(pattern: Pattern, geometry: CropGeometry, order: int, radius: float) -> tuple[Array, float]:
    """Center (2,) of the markers, crop pixels, and how well the pattern at rest fits itself turned about it.

    That is the mean correlation over the turns; 1 is perfect.

    Parameters
    ----------
    pattern : of `patterns_at_rest`
    order : of the symmetry
    radius : of the compared disk, in crop pixels
    """
    middle = geometry.to_crop(np.full(2, (geometry.side - 1) / 2.0))
    turns = [turn(2.0 * np.pi * k / order) for k in range(1, order)]

    def misfit(center: Array) -> float:
        return -pattern_correlation(pattern, geometry, center, turns, radius)

    simplex = middle + np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])
    options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-5}
    found = minimize(misfit, middle, method="Nelder-Mead", options=options)
    return np.asarray(found.x), -float(found.fun)


def find_mirror(
    pattern: Pattern, geometry: CropGeometry, center: Array, order: int, radius: float
) -> tuple[float, float]:
    """Direction (rad, from x to y) of a line through the center in which the pattern at rest is mirrored.

    And the correlation of the two; arguments as of `find_center`.
    """

    def misfit(direction: float) -> float:
        return -pattern_correlation(pattern, geometry, center, [reflection(direction)], radius)

    step = np.pi / order / _DIRECTIONS  # after a half turn by 1 / order there is the next
    rough = min(step * np.arange(_DIRECTIONS), key=misfit)
    found = minimize_scalar(misfit, bounds=(rough - step, rough + step), method="bounded")
    return float(found.x), -float(found.fun)


def mirror_of_labels(seen: Array, mirrored: Array, labels: Array, directed: bool) -> float:
    """Direction (rad) in {s} of the line that images have been mirrored at.

    It is the one for which a linear map from images to their labels has the mirrored images right, too.

    Parameters
    ----------
    seen, mirrored : (N, F), the `glance` at each image and at each that was mirrored
    labels, directed : (N, 6 or more), as of `SymmetryAxis`
    """
    wanted = _directions(labels, directed)
    middle, mean = seen.mean(axis=0), wanted.mean(axis=0)
    seen, mirrored = seen - middle, mirrored - middle
    gram = seen.T @ seen
    gram += _RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    told = mirrored @ np.linalg.solve(gram, seen.T @ (wanted - mean)) + mean
    given, once = torch.from_numpy(labels).double(), torch.ones(len(labels), dtype=torch.int64)

    def misfit(direction: float) -> float:
        axis = SymmetryAxis((0.0,) * 4, 1, 1, direction, directed).double()
        moved = _directions(axis(given, once).detach().numpy(), directed)
        return float(((told - moved) ** 2).mean())

    return float(min(np.arange(0.0, np.pi, np.radians(1.0)), key=misfit))


def glance(image: Image) -> Array:
    """An image (side, side) in a few numbers (F,), blurred."""
    return cv2.resize(image, (_LOOK, _LOOK), interpolation=cv2.INTER_AREA).ravel().astype(np.float64)


def _directions(labels: Array, directed: bool) -> Array:
    """What of labels (N, 6 or more) has a direction in {s}: the edge's, or shear and tilt in like units."""
    if directed:
        return np.column_stack([np.cos(labels[:, 5]), np.sin(labels[:, 5])])
    pairs = [labels[:, 0:2], labels[:, 3:5]]
    return np.hstack([pair / np.sqrt(np.nanmean(pair**2)) for pair in pairs])


def patterns_at_rest(images: Image, depth: Array, rest: Image | None = None) -> list[Pattern]:
    """The markers in means (side, side) of the shallowest images (N, side, side), or in the one at `rest`.

    A few of thousands show them best; of a hundred it takes more, since each is of a contact somewhere.
    """
    order, part = np.argsort(depth, kind="stable"), max(1, round(_SHALLOW * len(images)))
    counts = sorted({min(count, len(images)) for count in (part, *_FEW)})
    means = [images[order[:count]].mean(axis=0) for count in counts]
    if rest is not None:
        means.insert(
            0, cv2.resize(rest, images.shape[2:0:-1], interpolation=cv2.INTER_AREA).astype(np.float64)
        )
    return [_markers(mean) for mean in means]


def _markers(mean: Array) -> Pattern:
    """What is small in a mean image: markers, not contacts and shades, and no brighter than most are."""
    bright = mean[mean >= mean.mean()]
    dimmed = np.minimum(mean, np.percentile(bright, _BRIGHT)).astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(dimmed, (0, 0), sigma) for sigma in (_BLUR, _SHADES))
    return np.asarray(fine - coarse, np.float32)


def pattern_correlation(
    pattern: Pattern, geometry: CropGeometry, center: Array, maps: Sequence[Array], radius: float
) -> float:
    """Mean correlation of a pattern with itself, mapped (2, 2) about `center`, within the disk.

    -1 where there is nothing to be seen.
    """
    disk = geometry.disk(center, radius)
    values = []
    for linear in maps:
        inverse = geometry.inverse_map(linear, center, np.zeros(2))
        pair = pattern[disk], warped(pattern, inverse)[disk]
        if min(np.ptp(each) for each in pair) == 0.0:
            return -1.0
        values.append(np.corrcoef(*pair)[0, 1])
    return float(np.mean(values))


def warped(image: NDArray, inverse_map: Array) -> NDArray:
    """The image with, in each pixel, its value at `inverse_map` (2, 3), interpolated; outside black."""
    return cv2.warpAffine(
        image, inverse_map, (image.shape[1], image.shape[0]), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    )
