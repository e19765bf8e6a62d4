"""The Gaussian density network: convolutional base, multi-dropout head, softbound inverse sigmas."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from tactile_perception.training.settings import GdnSettings

OUTPUTS = 6


def softbound(x: Tensor, lower: float, upper: float) -> Tensor:
    """`tactile_perception.softbound.softbound` for tensors, in their own precision."""
    above_lower = torch.log1p(torch.exp(-torch.abs(x - lower)))
    above_upper = torch.log1p(torch.exp(-torch.abs(x - upper)))
    return torch.clamp(torch.clamp(x, lower, upper) + (above_lower - above_upper), lower, upper)


class ConvBlock(nn.Sequential):
    """3x3 convolution, batch normalization, ReLU, 2x2 max-pooling: halves the image's side.

    The maximum commutes with ReLU, so pooling comes first and ReLU works on a quarter of the values. The
    normalization makes a bias of the convolution redundant.
    """

    def __init__(self, inputs: int, outputs: int, momentum: float) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel_size=3, padding=1, bias=False),
            nn.BatchNorm2d(outputs, momentum=momentum),
            nn.MaxPool2d(2),
            nn.ReLU(inplace=True),
        )


class MultiDropoutLinear(nn.Module):
    """One dropout layer and one single-output linear layer per output (the paper's multi-dropout).

    The layer computes gain * weight x + bias. One step of Adam moves every weight by the learning rate, and
    with thousands of positive features the outputs by several millimeters; the gain takes that back, and the
    weights start from zero, so that training does not have to recover from its first steps.
    """

    def __init__(self, features: int, dropouts: tuple[float, ...], gain: float = 1.0) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(len(dropouts), features))
        self.bias = nn.Parameter(torch.zeros(len(dropouts)))
        self.dropouts = dropouts
        self.gain = gain

    def forward(self, features: Tensor) -> Tensor:
        """(N, features) -> (N, outputs)."""
        if not self.training:
            return nn.functional.linear(features, self.gain * self.weight, self.bias)
        features = self.gain * features
        outputs = [
            nn.functional.dropout(features, p) @ self.weight[j] if p > 0.0 else features @ self.weight[j]
            for j, p in enumerate(self.dropouts)
        ]
        return torch.stack(outputs, dim=1) + self.bias


class Gdn(nn.Module):
    """Image -> mean and inverse standard deviation of each component of xi_sf (mm, rad).

    `forward` takes float (N, 1, size, size) in [0, 1] and returns two float32 tensors (N, 6).
    """

    def __init__(self, settings: GdnSettings) -> None:
        super().__init__()
        self.settings = settings
        channels = (1, *settings.channels)
        self.base = nn.Sequential(
            *(ConvBlock(a, b, settings.batch_norm_momentum) for a, b in pairwise(channels))
        )
        side = settings.image_size // 2 ** len(settings.channels)
        if side < 1:
            raise ValueError(
                f"{len(settings.channels)} blocks halve an image of {settings.image_size} pixels to nothing"
            )
        features = channels[-1] * side * side
        dropouts = settings.dropout_mean + settings.dropout_inverse_sigma
        self.head = MultiDropoutLinear(features, dropouts, settings.head_gain)

    def start_from(self, labels: Tensor) -> None:
        """Let the untrained network answer with the labels' own mean and deviation; labels (N, 6)."""
        with torch.no_grad():
            self.head.bias[:OUTPUTS] = labels.mean(dim=0)
            inverse_sigma = 1.0 / labels.std(dim=0).clamp(min=1e-3)
            # Softbound is close to softplus here: this is the argument at which it gives 1/sigma.
            self.head.bias[OUTPUTS:] = inverse_sigma + torch.log(-torch.expm1(-inverse_sigma))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        features = self.base(images).flatten(1)
        with torch.autocast(features.device.type, enabled=False):
            outputs = self.head(features.float())
            lower, upper = self.settings.inverse_sigma_bounds
            return outputs[:, :OUTPUTS], softbound(outputs[:, OUTPUTS:], lower, upper)


def mean_nll(labels: Tensor, mean: Tensor, inverse_sigma: Tensor) -> Tensor:
    """Mean negative log-likelihood over a batch (paper, eq. gdn_mean_nll_loss_def)."""
    constant = 0.5 * labels.shape[1] * torch.log(torch.tensor(2.0 * torch.pi))
    terms = (inverse_sigma * (labels - mean)) ** 2 - 2.0 * torch.log(inverse_sigma)
    return constant + 0.5 * terms.sum(dim=1).mean()
