"""A convolutional base that lays the image's markers back to where they rest before it reads them.

Depth, tilt and shear change how dense the markers are, which convolutions see at once. A twist only turns the
pattern by less than a marker's width, on top of displacements of several times that: which marker is where
has to be known first. So the base looks twice: it finds the displacement field roughly, pulls the image back
by it, and measures in the result, whose markers are nearly at rest, what is left.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from tactile_perception.training.convolutions import convolutions
from tactile_perception.training.marker_field import MarkerFields, all_mapped, polynomials
from tactile_perception.training.output_layer import MultiDropoutLinear
from tactile_perception.training.settings import NetworkSettings
from tactile_perception.training.symmetry import CropGeometry

Array = NDArray[np.float64]

#: Modes of the field by which the image is pulled back.
COARSE_MODES = 20
_GAIN = 0.1  # `network.head_gain`'s default: here, too, there are thousands of features


class Registration(nn.Module):
    """Images (N, channels, size, size) -> modes of the markers' displacement field (N, M).

    Attributes
    ----------
    count, coarse_count : of the modes at the second and at the first look
    mean, modes : (M,) and (M, M), a field's numbers are mean + modes @ q (`MarkerFields.modes`)
    rest : (2 size^2,) of each pixel, where its content comes from in the mean field; -1 to 1 across the image
    shifts : (coarse, 2 size^2) what each mode adds to that
    """

    mean: Tensor
    modes: Tensor
    rest: Tensor
    shifts: Tensor

    def __init__(self, settings: NetworkSettings, channels: int) -> None:
        super().__init__()
        self.size, self.order = settings.image_size, settings.field_order
        self.first, self.second = convolutions(settings, channels), convolutions(settings, channels)
        features = settings.channels[-1] * settings.last_side**2
        self.count = count = (self.order + 1) * (self.order + 2)
        self.coarse_count = min(COARSE_MODES, count)
        self.coarse = MultiDropoutLinear(features, (0.0,) * self.coarse_count, _GAIN)
        self.fine = MultiDropoutLinear(features, (0.0,) * count, _GAIN)
        self.register_buffer("mean", torch.zeros(count))
        self.register_buffer("modes", torch.zeros(count, count))
        self.register_buffer("rest", torch.zeros(2 * self.size**2))
        self.register_buffer("shifts", torch.zeros(self.coarse_count, 2 * self.size**2))

    def place(self, fields: MarkerFields, crop_shape: tuple[int, int], copies: Array) -> None:
        """Take the disc from training data, and the modes unless another network has given its own.

        `copies` (n, 2, 2): how images are turned and mirrored in training.
        """
        if not self.modes.any():
            mean, modes = fields.modes(self.order, copies)
            self.mean.copy_(torch.from_numpy(mean))
            self.modes.copy_(torch.from_numpy(modes))
        pixels = np.stack(np.meshgrid(*2 * [np.arange(float(self.size))]), axis=-1).reshape(-1, 2)
        points = CropGeometry(crop_shape, self.size).to_crop(pixels)
        basis = polynomials((points - fields.center) / fields.radius, self.order)
        across = np.array(crop_shape[::-1])[:, None] / 2.0
        numbers = np.column_stack([self.mean.cpu(), self.modes.cpu()[:, : self.coarse_count]])
        shifts = np.einsum("pf,fdm->mpd", basis, numbers.reshape(-1, 2, numbers.shape[1]) / across)
        self.rest.copy_(torch.from_numpy(((2.0 * pixels + 1.0) / self.size - 1.0 + shifts[0]).ravel()))
        self.shifts.copy_(torch.from_numpy(shifts[1:].reshape(self.coarse_count, -1)))

    def forward(self, images: Tensor) -> Tensor:
        return self.looks(images)[1]

    def looks(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Modes at the first look (N, coarse) and at the second (N, M)."""
        coarse = _read(self.coarse, self.first(images))
        first = coarse.detach()
        fine = _read(self.fine, self.second(self.pulled_back(images, first)))
        return coarse, fine + functional.pad(first, (0, self.count - self.coarse_count))

    def pulled_back(self, images: Tensor, coarse: Tensor) -> Tensor:
        """Images whose markers lie where they rest, as far as a rough field is right."""
        with torch.autocast(images.device.type, enabled=False):
            grid = (self.rest + coarse.float() @ self.shifts).unflatten(1, (self.size, self.size, 2))
            return functional.grid_sample(images.float(), grid, align_corners=False)


def _read(layer: MultiDropoutLinear, features: Tensor) -> Tensor:
    with torch.autocast(features.device.type, enabled=False):
        result: Tensor = layer(features.float().flatten(1))
        return result


class FieldTargets:
    """What a `Registration` is to say of training images, turned and mirrored as `copies` (n, 2, 2) say.

    Attributes
    ----------
    known : samples whose fields are known
    """

    def __init__(self, fields: MarkerFields, base: Registration, copies: Array, device: torch.device) -> None:
        mean, modes = base.mean.cpu().double().numpy(), base.modes.cpu().double().numpy()
        values = np.linalg.solve(modes, (fields.values.reshape(len(fields.values), -1) - mean).T).T
        self._values = torch.from_numpy(values).float().to(device)
        turns = all_mapped(base.order, copies)
        shifts = np.linalg.solve(modes, (turns @ mean - mean).T).T
        self._maps = torch.from_numpy(np.linalg.solve(modes, turns @ modes)).float().to(device)
        self._shifts = torch.from_numpy(shifts).float().to(device)
        self.known = np.flatnonzero(fields.known)

    def __call__(self, samples: Tensor, turns: NDArray[np.int64]) -> Tensor:
        """(n, M); NaN where the markers were not followed."""
        chosen = torch.from_numpy(turns).to(self._maps.device)
        return torch.einsum("nij,nj->ni", self._maps[chosen], self._values[samples]) + self._shifts[chosen]
