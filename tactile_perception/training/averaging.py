"""Exponential moving average of a network's weights and statistics over the steps of training."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn


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
