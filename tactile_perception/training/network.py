"""The pose networks, a convolutional base and a head; and averages of their weights."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from tactile_perception.estimating.contact_model import SURFACE, ContactModel
from tactile_perception.training.heads import Head, make_head
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


class MultiDropoutLinear(nn.Module):
    """One dropout layer and one single-output linear layer per output (the paper's multi-dropout).

    The layer computes gain * weight x + bias. One step of Adam moves every weight by the learning rate, and
    with thousands of positive features the outputs by several millimeters; the gain takes that back, and the
    weights start from zero, so that training does not have to recover from its first steps.
    """

    def __init__(
        self, features: int, dropouts: tuple[float, ...], gain: float = 1.0, shared: bool = False
    ) -> None:
        """`shared`: one dropout layer, with the first probability, for all outputs (the paper's CNN)."""
        super().__init__()
        self.shared = shared
        self.weight = nn.Parameter(torch.zeros(len(dropouts), features))
        self.bias = nn.Parameter(torch.zeros(len(dropouts)))
        self.dropouts = dropouts
        self.gain = gain
        self.dropped = [index for index, p in enumerate(dropouts) if p > 0.0]
        probabilities = torch.tensor([dropouts[index] for index in self.dropped], dtype=torch.float64)
        self.places: Tensor
        self.thresholds: Tensor
        self.factors: Tensor
        # Random integers lie in [0, 2^31).
        constants = {
            "places": torch.tensor(self.dropped, dtype=torch.int64),
            "thresholds": (probabilities * 2.0**31).to(torch.int32),
            "factors": (1.0 / (1.0 - probabilities)).float()[:, None],
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, features: Tensor) -> Tensor:
        """(N, features) -> (N, outputs)."""
        if not self.training:
            return functional.linear(features, self.gain * self.weight, self.bias)
        features = self.gain * features
        if self.shared:
            return functional.linear(functional.dropout(features, self.dropouts[0]), self.weight, self.bias)
        outputs = functional.linear(features, self.weight, self.bias)
        if self.dropped:
            outputs = outputs.index_copy(1, self.places, self._with_dropout(features))
        return outputs

    def _with_dropout(self, features: Tensor) -> Tensor:
        """The outputs (N, dropped) whose features are dropped, each its own.

        All random numbers are drawn at once, and as integers: two thirds of the time of separate layers.
        """
        bits = torch.empty((len(self.dropped), *features.shape), dtype=torch.int32, device=features.device)
        kept = (bits.random_() >= self.thresholds[:, None, None]).to(features.dtype)
        weights = self.weight[self.places] * self.factors
        return torch.einsum("knf,kf->nk", features * kept, weights) + self.bias[self.places]


class PoseNetwork(nn.Module):
    """Image -> what the head needs to tell mean and covariance of a contact model's quantities.

    `forward` takes float (N, channels, size, size) in [0, 1] and returns float32 (N, head.outputs).
    """

    def __init__(self, settings: NetworkSettings, model: ContactModel = SURFACE, channels: int = 1) -> None:
        super().__init__()
        self.settings, self.channels = settings, channels
        self.distribution: Head = make_head(settings, model)
        momentum = settings.batch_norm_momentum
        blocks = [
            ConvBlock(a, b, momentum, pooled=index < settings.poolings)
            for index, (a, b) in enumerate(pairwise(settings.channels), start=1)
        ]
        first = FirstBlock(settings.first_stride, settings.channels[0], momentum, channels)
        self.base = nn.Sequential(first, *blocks)
        features = settings.channels[-1] * settings.last_side**2
        dropouts = self.distribution.dropouts
        shared = settings.head == "mse" and len(set(dropouts)) == 1
        self.head = MultiDropoutLinear(features, dropouts, settings.head_gain, shared)

    def start_from(self, labels: Tensor) -> None:
        """Let the untrained network answer with the labels' own mean and deviation; labels (N, K).

        Of what is not labelled (NaN) it answers with the prior.
        """
        mean, sigma = labels.mean(dim=0), labels.std(dim=0)
        for k in torch.nonzero(~torch.isfinite(sigma))[:, 0].tolist():
            known = labels[:, k][torch.isfinite(labels[:, k])]
            prior = [float(values[k]) for values in self.distribution.model.prior]
            mean[k], sigma[k] = (known.mean(), known.std()) if len(known) > 1 else prior
        with torch.no_grad():
            self.head.bias.copy_(self.distribution.start(mean, sigma))

    def forward(self, images: Tensor) -> Tensor:
        features = self.base(images).flatten(1)
        with torch.autocast(features.device.type, enabled=False):
            outputs: Tensor = self.head(features.float())
            return outputs


class WeightAverage:
    """Average of everything in a network's state that is a real number; with decay 0 the network itself."""

    def __init__(self, network: nn.Module, decay: float) -> None:
        self._network, self._decay = network, decay
        self._values: dict[str, Tensor] = {}
        self._steps = 0

    @torch.no_grad()
    def update(self) -> None:
        """Take in the network as it is. The first steps weigh more, so that none of the start is left."""
        if self._decay == 0.0:
            return
        self._steps += 1
        decay = min(self._decay, self._steps / (self._steps + 10.0))
        for name, value in self._real_state():
            if name in self._values:
                self._values[name].lerp_(value, 1.0 - decay)
            else:
                self._values[name] = value.clone()

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """While this lasts, the network has the average's values."""
        if not self._values:
            yield
            return
        kept = {name: value.clone() for name, value in self._real_state()}
        self._load(self._values)
        try:
            yield
        finally:
            self._load(kept)

    def state(self) -> dict[str, object]:
        return {"values": self._values, "steps": self._steps}

    def restore(self, state: dict[str, object]) -> None:
        values, steps = state["values"], state["steps"]
        assert isinstance(values, dict) and isinstance(steps, int)
        device = next(self._network.parameters()).device
        self._values = {name: value.to(device) for name, value in values.items()}
        self._steps = steps

    def _real_state(self) -> list[tuple[str, Tensor]]:
        state = self._network.state_dict()
        return [(name, value) for name, value in state.items() if value.dtype.is_floating_point]

    @torch.no_grad()
    def _load(self, values: dict[str, Tensor]) -> None:
        for name, value in self._real_state():
            value.copy_(values[name])
