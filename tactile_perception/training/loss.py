"""The loss of a training step: of what the network tells, and of the markers' field where it finds that."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from tactile_perception.training.network import PoseNetwork
from tactile_perception.training.registration import FieldTargets, Registration
from tactile_perception.training.settings import TrainingSettings
from tactile_perception.training.symmetry import SymmetryAxis

#: The last layers see so many fields as they were followed for each image: these cost next to nothing.
FIELDS_A_SAMPLE = 8
Turns = NDArray[np.int64]


class StepLoss(nn.Module):
    """A network and the symmetry's axis, that learn together, as one module whose output is the loss."""

    def __init__(
        self,
        network: PoseNetwork,
        axis: SymmetryAxis | None,
        fields: FieldTargets | None,
        labels: Tensor,
        settings: TrainingSettings,
        low_precision: bool,
    ) -> None:
        """`labels` (N, K) of all training samples; `low_precision`: the base computes in bf16."""
        super().__init__()
        self.network, self.axis, self._low_precision = network, axis, low_precision
        self._fields, self._labels, self._settings = fields, labels, settings

    def draw(self, copies: int, rng: np.random.Generator) -> tuple[Turns, Turns] | None:
        """Samples and turns whose followed fields the last layers learn from; None without fields.

        `copies` is the number of those that images have; 1: no turns.
        """
        if self._fields is None:
            return None
        chosen = rng.choice(self._fields.known, FIELDS_A_SAMPLE * self._settings.batch_size)
        return chosen, rng.integers(0, copies, len(chosen))

    def forward(
        self, images: Tensor, samples: Tensor, turns: Turns, drawn: tuple[Turns, Turns] | None
    ) -> Tensor:
        """Of images (n, channels, size, size) of training samples (n,), turned so many times (n,)."""
        network, labels = self.network, self._turned(samples, turns)
        if self._fields is None:
            with self._autocast(images):
                raw = network(images)
            return network.distribution.loss(labels, raw)
        assert isinstance(network.base, Registration)
        with self._autocast(images):
            coarse, fine = network.base.looks(images)
        wanted = self._fields(samples, turns)
        loss = network.distribution.loss(labels, network.answer(fine))
        for found in (coarse, fine):
            error = found - wanted[:, : found.shape[1]]
            loss = loss + self._settings.field_weight * torch.nan_to_num(error).square().mean()
        return loss if drawn is None else loss + self._of_fields(*drawn)

    def _of_fields(self, chosen: Turns, turns: Turns) -> Tensor:
        """Of the last layers on fields that were followed in images, with errors as the base's."""
        assert self._fields is not None
        samples = torch.from_numpy(chosen).to(self._labels.device)
        fields = self._fields(samples, turns)
        fields = fields + self._settings.field_noise * torch.randn_like(fields)
        return self.network.distribution.loss(self._turned(samples, turns), self.network.answer(fields))

    def _turned(self, samples: Tensor, turns: Turns) -> Tensor:
        labels = self._labels[samples]
        # on what is not turned the axis has no part, and no step of the optimizer is to move it
        if self.axis is None or not turns.any():
            return labels
        turned: Tensor = self.axis(labels, torch.from_numpy(turns).to(labels.device))
        return turned

    def _autocast(self, images: Tensor) -> torch.autocast:
        return torch.autocast(images.device.type, dtype=torch.bfloat16, enabled=self._low_precision)
