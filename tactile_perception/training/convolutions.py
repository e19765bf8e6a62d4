"""Convolutional base of a pose network: blocks that halve an image's side."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from tactile_perception.training.settings import NetworkSettings


class ConvBlock(nn.Sequential):
    """3x3 convolution, batch normalization, ReLU and, if `pooled`, 2x2 max-pooling that halves the side.

    The maximum commutes with ReLU, so pooling comes first and ReLU works on a quarter of the values. The
    normalization makes a bias of the convolution redundant.
    """

    def __init__(self, inputs: int, outputs: int, momentum: float, pooled: bool = True) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel_size=3, padding=1, bias=False),
            nn.BatchNorm2d(outputs, momentum=momentum),
            nn.MaxPool2d(2) if pooled else nn.Identity(),
            nn.ReLU(inplace=True),
        )

    @property
    def pooled(self) -> bool:
        return isinstance(self[2], nn.MaxPool2d)


class FirstBlock(ConvBlock):
    """A ConvBlock on the image that normalizes without touching its largest feature map.

    Mean and variance of a convolution's output follow from mean and covariance of the patches of its input:
    with one or three channels in, far less work than from the output. The normalization then is part of the
    convolution's weights: the same numbers and gradients. A stride s convolves with 3s x 3s pixels.
    """

    def __init__(self, stride: int, outputs: int, momentum: float, channels: int = 1) -> None:
        super().__init__(channels * stride * stride, outputs, momentum)
        self.stride = stride

    def forward(self, images: Tensor) -> Tensor:
        if self.stride > 1:
            images = functional.pixel_unshuffle(images, self.stride)
        if not self.training:
            return super().forward(images)
        convolution, norm = self[0], self[1]
        assert isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d)
        with torch.autocast(images.device.type, enabled=False):
            kernels = convolution.weight.flatten(1)
            mean, covariance = patch_moments(images)
            output_mean = kernels @ mean
            output_variance = ((kernels @ covariance) * kernels).sum(dim=1)
            count = images.numel() // images.shape[1]
            _update_statistics(norm, output_mean, output_variance, count)
            scale = norm.weight * torch.rsqrt(output_variance + norm.eps)
            weight = convolution.weight * scale[:, None, None, None]
            bias = norm.bias - output_mean * scale
        pooled = self[2](functional.conv2d(images, weight, bias, padding=1))
        result: Tensor = self[3](pooled)
        return result


@torch.no_grad()
def patch_moments(images: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (9 C,) and covariance (9 C, 9 C) of the zero-padded 3x3 patches of images (N, C, H, W).

    The order within a patch is that of a convolution's flattened weights.
    """
    rows, columns = images.shape[2:]
    padded = functional.pad(images, (1, 1, 1, 1))
    patches = torch.stack(
        [
            padded[:, channel, i : i + rows, j : j + columns].reshape(-1)
            for channel in range(images.shape[1])
            for i in range(3)
            for j in range(3)
        ]
    )
    mean = patches.mean(dim=1)
    second = patches @ patches.T / patches.shape[1]
    return mean, second - torch.outer(mean, mean)


@torch.no_grad()
def _update_statistics(norm: nn.BatchNorm2d, mean: Tensor, variance: Tensor, count: int) -> None:
    assert norm.running_mean is not None and norm.running_var is not None and norm.momentum is not None
    norm.running_mean.lerp_(mean, norm.momentum)
    norm.running_var.lerp_(variance * (count / (count - 1.0)), norm.momentum)
    assert norm.num_batches_tracked is not None
    norm.num_batches_tracked += 1


def convolutions(settings: NetworkSettings, channels: int) -> nn.Sequential:
    """Blocks that turn images (N, channels, size, size) into (N, settings.features, side, side)."""
    momentum = settings.batch_norm_momentum
    blocks = [
        ConvBlock(a, b, momentum, pooled=index < settings.poolings)
        for index, (a, b) in enumerate(pairwise(settings.channels), start=1)
    ]
    return nn.Sequential(FirstBlock(settings.first_stride, settings.channels[0], momentum, channels), *blocks)
