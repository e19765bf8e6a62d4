"""The network that a training starts from: that of an earlier run, such as one on simulated images."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from tactile_base.settings import SettingError
from tactile_perception.training.config import TrainConfig
from tactile_perception.training.run_folder import BEST_NAME, CONFIG_NAME, FACTS_NAME, RunFolder
from tactile_perception.training.settings import NetworkSettings

#: Settings of a network in which the two may differ; all others decide which weights there are and what for.
_FREE = {
    "head",
    "batch_norm_momentum",
    "dropout_mean",
    "dropout_inverse_sigma",
    "dropout_correlation",
    "mse_weights",
    "redraw_radius",
}


@dataclass(frozen=True)
class Start:
    """Weights of a finished run, without its head's if that is of another kind; and what they come from."""

    weights: dict[str, Tensor]
    facts: dict[str, Any]

    def give(self, network: nn.Module) -> None:
        """Put the weights into a network; what they lack stays as it is."""
        network.load_state_dict({**network.state_dict(), **self.weights})


def load_start(run: Path | str, network: NetworkSettings) -> Start:
    """The best network of a finished run of `tactile train`, for a run whose network has these settings.

    Raises
    ------
    SettingError
        If the folder holds no finished run, or one of another network; the message says what differs.
    """
    folder = RunFolder(run)
    if not folder.finished:
        raise SettingError(f"training.start = {run}: is not the folder of a finished run of `tactile train`")
    config = TrainConfig.from_file(folder.file(CONFIG_NAME))
    for name in NetworkSettings.__dataclass_fields__:
        theirs, ours = getattr(config.network, name), getattr(network, name)
        if name not in _FREE and theirs != ours:
            raise SettingError(
                f"training.start = {run}: its network has {name} = {theirs}, this one {ours}; they must agree"
            )
    facts = json.loads(folder.file(FACTS_NAME).read_text())
    facts["holdback"] = config.training.holdback
    facts["weights_sha256"] = hashlib.sha256(folder.file(BEST_NAME).read_bytes()).hexdigest()
    weights = folder.load_best()
    if config.network.head != network.head:
        weights = {name: value for name, value in weights.items() if not name.startswith("head.")}
    return Start(weights, facts)
