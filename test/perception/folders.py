"""Data folders for tests."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from tactile_perception.datasets.dataset import DatasetWriter
from tactile_perception.estimating.preprocessing import PreprocessingSettings


def write_folder(path: Path, samples: Iterable[tuple[np.ndarray, np.ndarray]]) -> Path:
    """A data folder of camera images and their Euler surface contact poses in mm and degrees."""
    with DatasetWriter(path, PreprocessingSettings()) as writer:
        for number, (image, euler) in enumerate(samples, start=1):
            writer.add(number, image, euler)
        writer.finish()
    return path


def dot_image(euler: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A camera image whose one large blob tells x, y (place) and z (size)."""
    rows, columns = np.mgrid[:480, :640]
    distance = np.hypot(columns - 327 - 15 * euler[0], rows - 240 - 15 * euler[1])
    image = 40.0 + 160.0 * (distance < 20 + 12 * euler[2])
    grid = (rows % 24 < 6) & (columns % 24 < 6)
    return np.clip(image + 60.0 * grid + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8)
