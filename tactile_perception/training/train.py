"""Training of a pose network on a data folder, from images to the model file."""

from __future__ import annotations

from pathlib import Path

from tactile_perception.training.config import TrainConfig
from tactile_perception.training.data import load_data
from tactile_perception.training.loop import train_network
from tactile_perception.training.progress import TrainingProgress
from tactile_perception.training.run_folder import Epoch, RunFolder, TrainResult

__all__ = ["Epoch", "TrainConfig", "TrainResult", "TrainingProgress", "train"]


def train(
    data_dir: Path | str,
    out_dir: Path | str,
    config: TrainConfig | None = None,
    validation_dir: Path | str | None = None,
    limit: int | None = None,
    progress: TrainingProgress | None = None,
) -> TrainResult:
    """Train on a folder of the public layout and leave everything about the run in `out_dir`.

    A run that was interrupted goes on where its last whole epoch ended, when it is asked for again with the
    same configuration and data, and ends as it would have without the interruption.

    Parameters
    ----------
    data_dir : path
        Training data, or a folder that holds `train/` and `val/`.
    out_dir : path
        Gets `config.yaml`, `data.txt` (what was found in the folders) and `data.json` (their hashes),
        `epochs.csv`, `curves.png`, `best.pt`, `model.onnx` and, at the very end, `result.json`.
    validation_dir : path, optional
        Validation data; required unless `data_dir` holds `val/`.
    limit : int, optional
        Use this many training samples only.

    Returns
    -------
    TrainResult

    Raises
    ------
    DatasetError, SettingError, AugmentationError, CalibrationError
        Unusable data or configuration.
    FileExistsError
        If `out_dir` holds a finished run, or one with another configuration or other data.
    """
    config = config or TrainConfig()
    progress = progress or TrainingProgress()
    folder = RunFolder(out_dir)
    folder.check_free()  # before the images are read
    data = load_data(Path(data_dir), validation_dir, config, limit, progress.loading)
    return train_network(data, folder, config, progress)
