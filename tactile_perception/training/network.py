"""The pose networks, a convolutional base and a head; and averages of their weights."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from tactile_perception.estimating.contact_model import SURFACE, ContactModel
from tactile_perception.training.convolutions import convolutions
from tactile_perception.training.heads import Head, make_head
from tactile_perception.training.output_layer import MultiDropoutLinear
from tactile_perception.training.registration import Registration
from tactile_perception.training.settings import NetworkSettings


class PoseNetwork(nn.Module):
    """Image -> what the head needs to tell mean and covariance of a contact model's quantities.

    `forward` takes float (N, channels, size, size) in [0, 1] and returns float32 (N, head.outputs).
    """

    def __init__(self, settings: NetworkSettings, model: ContactModel = SURFACE, channels: int = 1) -> None:
        super().__init__()
        self.settings, self.channels = settings, channels
        self.distribution: Head = make_head(settings, model)
        self.base: nn.Sequential | Registration
        if settings.field_order:
            self.base = Registration(settings, channels)
            features = self.base.count
        else:
            self.base = convolutions(settings, channels)
            features = settings.channels[-1] * settings.last_side**2
        layers: list[nn.Module] = []
        for size in settings.hidden:
            layers += [nn.Linear(features, size), nn.SiLU(inplace=True)]
            features = size
        self.hidden = nn.Sequential(*layers)
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
        return self.answer(self.base(images).flatten(1))

    def answer(self, features: Tensor) -> Tensor:
        """Raw outputs for what the base gives."""
        with torch.autocast(features.device.type, enabled=False):
            outputs: Tensor = self.head(self.hidden(features.float()))
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
