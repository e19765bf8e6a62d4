"""What a plain network tells: four convolutions and absolute errors, as contacts.py holds ours against it."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from torch import nn

from tactile_perception.estimating.contact_model import ContactModel
from tactile_perception.estimating.preprocessing import as_input

CHANNELS = (16, 32, 64, 128)
HIDDEN, BATCH, EPOCHS, RATE = 256, 16, 60, 1e-3


class PlainNetwork:
    """Trained on images (uint8) and labels (N, K); of its epochs the one that errs least on the second pair.

    An angle that goes all round is told by sine and cosine. Its covariance is that of its errors there.
    """

    def __init__(self, model: ContactModel, seed: int, *pairs: tuple[np.ndarray, np.ndarray]) -> None:
        torch.manual_seed(seed)
        self._model, self._turning = model, list(model.turning)
        (images, labels), (others, known) = pairs
        inputs, targets = torch.from_numpy(as_input(images)), torch.from_numpy(self._targets(labels))
        self._center, self._scale = targets.mean(dim=0), targets.std(dim=0)
        finite = torch.isfinite(self._center) & (self._scale > 0.0)
        self._network = layers(inputs.shape[1], inputs.shape[-1], len(self._center))
        optimizer = torch.optim.Adam(self._network.parameters(), RATE)
        steps = EPOCHS * -(-len(inputs) // BATCH)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        seen, spread = as_input(others), np.nan_to_num(known).std(axis=0) + 1e-12
        targets, least = ((targets - self._center) / self._scale)[:, finite], np.inf
        for _ in range(EPOCHS):
            self._network.train()
            for rows in torch.randperm(len(inputs)).split(BATCH):
                loss = (self._network(inputs[rows])[:, finite] - targets[rows]).abs().mean()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                schedule.step()
            error = np.nan_to_num(model.error(self._mean(seen), known))  # none where unlabelled
            score = float((np.abs(error) / spread).mean())
            if score < least:
                least, best = score, copy.deepcopy(self._network.state_dict())
                self._covariance = np.diag((error**2).mean(axis=0) + 1e-12)
        self._network.load_state_dict(best)

    def predict_uncalibrated(self, batch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means (N, K) and covariances (N, K, K), as of `Estimator`."""
        mean = self._mean(batch)
        return mean, np.broadcast_to(self._covariance, (len(mean), *self._covariance.shape))

    def _targets(self, labels: np.ndarray) -> np.ndarray:
        targets = np.hstack([labels, np.cos(labels[:, self._turning])])
        targets[:, self._turning] = np.sin(labels[:, self._turning])
        return targets.astype(np.float32)

    def _mean(self, inputs: np.ndarray) -> np.ndarray:
        self._network.eval()
        with torch.no_grad():
            raw = [
                self._network(part) * self._scale + self._center
                for part in torch.from_numpy(inputs).split(256)
            ]
        told = torch.cat(raw).double().numpy()
        mean = told[:, : self._model.size].copy()
        mean[:, self._turning] = np.arctan2(told[:, self._turning], told[:, self._model.size :])
        return np.nan_to_num(mean)


def layers(channels: int, side: int, outputs: int) -> nn.Sequential:
    """Four convolutions, each halved by the largest of four, and two layers that see all of it."""
    found: list[Any] = []
    for wide in CHANNELS:
        found += [nn.Conv2d(channels, wide, 3, padding=1), nn.ReLU(), nn.MaxPool2d(2)]
        channels, side = wide, side // 2
    inner = [nn.Flatten(), nn.Linear(channels * side**2, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, outputs)]
    return nn.Sequential(*found, *inner)
