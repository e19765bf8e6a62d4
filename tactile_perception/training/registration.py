"""A convolutional base that lays the image's markers back to where they rest before it reads them.

Depth, tilt and shear change how dense the markers are, which convolutions see at once. A twist only turns the
pattern by less than a marker's width, on top of displacements of several times that: which marker is where
has to be known first. So the base looks twice: it finds the displacement field roughly, pulls the image back by it,
and measures in the result, whose markers are nearly at rest, what is left.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from tactile_perception.training.convolutions import convolutions
from tactile_perception.training.marker_field import MarkerFields, orders, polynomials, turned
from tactile_perception.training.settings import NetworkSettings

#: Radial order of the polynomials by which the image is pulled back.
COARSE_ORDER = 4
#: Factor on thousands of features, as `network.head_gain`.
GAIN = 0.1


class Registration(nn.Module):
    """Images (N, channels, size, size) -> displacement fields (N, 2 F), each number of about the same size.

    A field's numbers are divided by the root of their deviation over the training data: small parts of a
    field, that tell the twist, weigh more than by their pixels, and less than if all had the same deviation.
    """

    def __init__(self, settings: NetworkSettings, channels: int) -> None:
        super().__init__()
        self.size = settings.image_size
        self.first, self.second = convolutions(settings, channels), convolutions(settings, channels)
        features = settings.channels[-1] * settings.last_side**2
        self.order = settings.field_order
        count = len(orders(self.order))
        self.coarse_count = len(orders(min(COARSE_ORDER, self.order)))
        self.coarse = nn.Linear(features, 2 * self.coarse_count)
        self.fine = nn.Linear(features, 2 * count)
        for layer in (self.coarse, self.fine):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        pixels = self.size**2
        self.scale: Tensor
        self.rest: Tensor
        self.dense: Tensor
        self.pixel: Tensor
        self.register_buffer("scale", torch.ones(2 * count))  # of a field's numbers, in pixels of the crop
        self.register_buffer("rest", torch.zeros(pixels, 2))  # of each pixel, from -1 to 1 across the image
        self.register_buffer(
            "dense", torch.zeros(self.coarse_count, pixels)
        )  # each number's part in the shift
        self.register_buffer("pixel", torch.ones(2))  # of the crop, as part of the image from -1 to 1

    def place(self, fields: MarkerFields, crop_shape: tuple[int, int], symmetry: int) -> None:
        """Take disc, scale and mean from training data that get turned by multiples of 1 / symmetry."""
        rows, columns = crop_shape
        across = np.array([columns, rows], dtype=np.float64)
        pixel = (np.arange(self.size) + 0.5) / self.size
        place = np.stack(np.meshgrid(pixel, pixel), axis=-1).reshape(-1, 2)
        points = (place * across - 0.5 - fields.center) / fields.radius
        mean, deviation = fields.mean_and_scale(self.order, symmetry)
        scale = np.sqrt(deviation * deviation.mean())
        values = {
            "scale": np.repeat(scale, 2),
            "rest": 2.0 * place - 1.0,
            "dense": (polynomials(points, self.order)[:, : self.coarse_count] * scale[: self.coarse_count]).T,
            "pixel": 2.0 / across,
        }
        for name, value in values.items():
            getattr(self, name).copy_(torch.from_numpy(value))
        with torch.no_grad():
            start = (mean / scale[:, None])[: self.coarse_count].ravel()
            self.coarse.bias.copy_(torch.from_numpy(start))

    def forward(self, images: Tensor) -> Tensor:
        return self.looks(images)[1]

    def looks(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """The field at the first look (N, 2 coarse_count) and at the second (N, 2 F)."""
        coarse = self._read(self.coarse, self.first(images))
        first = coarse.detach()
        fine = self._read(self.fine, self.second(self.pulled_back(images, first)))
        return coarse, fine + functional.pad(first, (0, fine.shape[1] - first.shape[1]))

    def pulled_back(self, images: Tensor, coarse: Tensor) -> Tensor:
        """Images whose markers lie where they rest, as far as a rough field is right."""
        with torch.autocast(images.device.type, enabled=False):
            parts = coarse.float().unflatten(1, (-1, 2)).transpose(1, 2)
            shift = torch.matmul(parts, self.dense).transpose(1, 2) * self.pixel
            grid = (self.rest + shift).unflatten(1, (self.size, self.size))
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
        scale = base.scale.cpu()
        values = torch.from_numpy(fields.values).flatten(1)
        self._values = (values / scale).to(device)
        maps = [turned(base.order, 2.0 * np.pi * k / symmetry) for k in range(symmetry)]
        # what a turn mixes has the same scale
        self._maps = torch.from_numpy(np.stack(maps)).float().to(device)
        self.known = np.flatnonzero(fields.known)

    def __call__(self, samples: Tensor, turns: NDArray[np.int64]) -> Tensor:
        """(n, 2 F); NaN where the markers were not followed."""
        maps = self._maps[torch.from_numpy(turns).to(self._maps.device)]
        return torch.einsum("nij,nj->ni", maps, self._values[samples])
