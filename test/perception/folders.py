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
