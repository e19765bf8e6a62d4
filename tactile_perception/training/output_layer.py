"""The layer that ends a base or a network: outputs that start from zero, each with a dropout of its own."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional


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
