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
from tactile_perception.training.marker_field import MarkerFields, polynomials, turned
from tactile_perception.training.settings import NetworkSettings

#: Modes of the field by which the image is pulled back.
COARSE_MODES = 20
#: Factor on thousands of features, as `network.head_gain`.
GAIN = 0.1


class Registration(nn.Module):
    """Images (N, channels, size, size) -> modes of the markers' displacement field (N, M).

    Attributes
    ----------
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
        count = (self.order + 1) * (self.order + 2)
        self.coarse = nn.Linear(features, min(COARSE_MODES, count))
        self.fine = nn.Linear(features, count)
        for layer in (self.coarse, self.fine):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        self.register_buffer("mean", torch.zeros(count))
        self.register_buffer("modes", torch.zeros(count, count))
        self.register_buffer("rest", torch.zeros(2 * self.size**2))
        self.register_buffer("shifts", torch.zeros(self.coarse.out_features, 2 * self.size**2))

    def place(self, fields: MarkerFields, crop_shape: tuple[int, int], symmetry: int) -> None:
        """Take the disc from training data, and the modes unless another network has given its own."""
        if not self.modes.any():
            mean, modes = fields.modes(self.order, symmetry)
            self.mean.copy_(torch.from_numpy(mean))
            self.modes.copy_(torch.from_numpy(modes))
        rows, columns = crop_shape
        across = np.array([columns, rows], dtype=np.float64)
        pixel = (np.arange(self.size) + 0.5) / self.size
        place = np.stack(np.meshgrid(pixel, pixel), axis=-1).reshape(-1, 2)
        basis = polynomials((place * across - 0.5 - fields.center) / fields.radius, self.order)
        scale = (2.0 / across)[:, None]
        numbers = np.column_stack([self.mean.cpu(), self.modes.cpu()[:, : len(self.shifts)]])
        shifts = np.einsum("pf,fdm->mpd", basis, numbers.reshape(-1, 2, numbers.shape[1]) * scale)
        self.rest.copy_(torch.from_numpy((2.0 * place - 1.0 + shifts[0]).ravel()))
        self.shifts.copy_(torch.from_numpy(shifts[1:].reshape(len(self.shifts), -1)))

    def forward(self, images: Tensor) -> Tensor:
        return self.looks(images)[1]

    def looks(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Modes at the first look (N, coarse) and at the second (N, M)."""
        coarse = self._read(self.coarse, self.first(images))
        first = coarse.detach()
        fine = self._read(self.fine, self.second(self.pulled_back(images, first)))
        return coarse, fine + functional.pad(first, (0, fine.shape[1] - first.shape[1]))

    def pulled_back(self, images: Tensor, coarse: Tensor) -> Tensor:
        """Images whose markers lie where they rest, as far as a rough field is right."""
        with torch.autocast(images.device.type, enabled=False):
            grid = (self.rest + coarse.float() @ self.shifts).unflatten(1, (self.size, self.size, 2))
            return functional.grid_sample(images.float(), grid, align_corners=False)

    def _read(self, layer: nn.Linear, features: Tensor) -> Tensor:
        with torch.autocast(features.device.type, enabled=False):
            result: Tensor = layer(GAIN * features.float().flatten(1))
            return result


class FieldTargets:
    """What a `Registration` is to say of training images and of turned ones.

    Attributes
    ----------
    known : samples whose fields are known
    """

    def __init__(self, fields: MarkerFields, base: Registration, symmetry: int, device: torch.device) -> None:
        mean, modes = base.mean.cpu().double().numpy(), base.modes.cpu().double().numpy()
        values = np.linalg.solve(modes, (fields.values.reshape(len(fields.values), -1) - mean).T).T
        self._values = torch.from_numpy(values).float().to(device)
        turns = [turned(base.order, 2.0 * np.pi * k / symmetry) for k in range(symmetry)]
        of_modes = [np.linalg.solve(modes, turn @ modes) for turn in turns]
        shifts = [np.linalg.solve(modes, turn @ mean - mean) for turn in turns]
        self._maps = torch.from_numpy(np.stack(of_modes)).float().to(device)
        self._shifts = torch.from_numpy(np.stack(shifts)).float().to(device)
        self.known = np.flatnonzero(fields.known)

    def __call__(self, samples: Tensor, turns: NDArray[np.int64]) -> Tensor:
        """(n, M); NaN where the markers were not followed."""
        chosen = torch.from_numpy(turns).to(self._maps.device)
        return torch.einsum("nij,nj->ni", self._maps[chosen], self._values[samples]) + self._shifts[chosen]
