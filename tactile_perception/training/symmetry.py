"""The symmetry of the marker pattern: turning an image about the markers' center, and its label with it.

The TacTip's 331 markers lie in rings of 1 + 6 + 12 + ... + 60, so that the sensor looks the same after a
sixth of a turn about its axis. An image turned so is the image of a contact turned likewise: with S the turn
about the axis, X' = S X S^-1, which in exponential coordinates is exactly xi' = Ad_S xi. Were the axis the z
axis of {s}, that would turn rho and phi; in practice the labels' {s} stands a few millimeters beside the
markers' axis, and the axis is learned with the network's weights.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor, nn

from tactile_perception.estimating.image import Image

Array = NDArray[np.float64]

#: Blur of the mean image before images are compared, in pixels.
_BLUR = 2.0
#: Part of the samples, the shallowest ones, whose mean shows the markers nearly at rest.
_SHALLOW = 0.03


def turn(angle: float) -> Array:
    """(2, 2) rotation from x to y by `angle` (rad)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


class SymmetryAxis(nn.Module):
    """The axis about which labels are turned: a trainable offset and tilt in {s}.

    Attributes
    ----------
    values : (4,) offset x, y in mm and tilt about x, y in units of 1/50 rad, of like effect on the labels
    """

    TILT_UNIT = 0.02

    def __init__(self, start: tuple[float, ...], order: int, sense: int) -> None:
        """`start`: x, y in mm, tilt about x, y in rad; turns are multiples of sense / order of a circle."""
        super().__init__()
        units = torch.tensor([1.0, 1.0, self.TILT_UNIT, self.TILT_UNIT])
        self.values = nn.Parameter(torch.tensor(start) / units)
        self.units: Tensor
        self.register_buffer("units", units)
        turns = torch.eye(6).repeat(order, 1, 1)
        for k in range(order):
            rotation = torch.tensor(turn(sense * 2.0 * np.pi * k / order), dtype=torch.float32)
            turns[k, 0:2, 0:2] = turns[k, 3:5, 3:5] = rotation
        self.turns: Tensor
        self.register_buffer("turns", turns)

    def parameters_of_axis(self) -> tuple[float, ...]:
        """x, y in mm, tilt about x, y in rad."""
        return tuple((self.values * self.units).tolist())

    def forward(self, labels: Tensor, turns: Tensor) -> Tensor:
        """Labels (N, 6 or 9) in mm, rad and N of the contacts turned `turns` (N,) times; exact for k = 0.

        A force, where there is one, turns with the sensor's axes.
        """
        x, y, tilt_x, tilt_y = (self.values * self.units).unbind()
        zero = torch.zeros_like(x)
        rotation = torch.linalg.matrix_exp(_hat(torch.stack([tilt_x, tilt_y, zero])))
        offset = _hat(torch.stack([x, y, zero])) @ rotation
        top = torch.cat([rotation, offset], dim=1)
        adjoint = torch.cat([top, torch.cat([torch.zeros_like(rotation), rotation], dim=1)])
        maps = adjoint @ self.turns @ torch.linalg.inv(adjoint)
        turned = torch.einsum("nij,nj->ni", maps[turns], labels[:, :6])
        if labels.shape[1] > 6:
            force = torch.einsum("nij,nj->ni", maps[turns][:, :3, :3], labels[:, 6:])
            turned = torch.cat([turned, force], dim=1)
        return torch.where(turns[:, None] == 0, labels, turned)


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


def find_center(
    images: Image, depth: Array, geometry: CropGeometry, order: int, radius: float
) -> tuple[Array, float]:
    """Center (2,) of the markers, crop pixels, and how well the pattern at rest fits itself turned about it.

    That is the mean correlation over the turns; 1 is perfect.

    Parameters
    ----------
    images : uint8 (N, side, side)
    depth : (N,); the mean over the shallowest images stands for the pattern at rest
    order : of the symmetry
    radius : of the compared disk, in crop pixels
    """
    count = max(1, round(_SHALLOW * len(images)))
    chosen = np.argsort(depth, kind="stable")[:count]
    pattern = cv2.GaussianBlur(images[chosen].mean(axis=0).astype(np.float32), (0, 0), _BLUR)
    middle = geometry.to_crop(np.full(2, (geometry.side - 1) / 2.0))

    def misfit(center: Array) -> float:
        return -pattern_correlation(np.asarray(pattern, np.float32), geometry, center, order, radius)

    simplex = middle + np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])
    options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-5}
    found = minimize(misfit, middle, method="Nelder-Mead", options=options)
    return np.asarray(found.x), -float(found.fun)


def pattern_correlation(
    pattern: NDArray[np.float32], geometry: CropGeometry, center: Array, order: int, radius: float
) -> float:
    """Mean correlation of a pattern (side, side) with itself, turned about `center`, within the disk."""
    disk = geometry.disk(center, radius)
    values = []
    for k in range(1, order):
        inverse = geometry.inverse_map(turn(2.0 * np.pi * k / order), center, np.zeros(2))
        values.append(np.corrcoef(pattern[disk], warped(pattern, inverse)[disk])[0, 1])
    return float(np.mean(values))


def warped(image: NDArray, inverse_map: Array) -> NDArray:
    """The image with, in each pixel, its value at `inverse_map` (2, 3), interpolated; outside black."""
    return cv2.warpAffine(
        image, inverse_map, (image.shape[1], image.shape[0]), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    )
