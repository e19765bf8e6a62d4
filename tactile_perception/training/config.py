"""Everything that decides a training run, as in a file of `config/perception/`."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tactile_base.settings import SettingError, Settings, unknown_name
from tactile_base.yaml_file import name_and_value, read_yaml
from tactile_perception.evaluation.calibration import CalibrationSettings
from tactile_perception.training.settings import AugmentationSettings, NetworkSettings, TrainingSettings

SECTIONS: dict[str, type[Settings]] = {
    "network": NetworkSettings,
    "training": TrainingSettings,
    "augmentation": AugmentationSettings,
    "calibration": CalibrationSettings,
}


@dataclass(frozen=True)
class TrainConfig:
    """The sections of a training file; the defaults are the paper's GDN."""

    network: NetworkSettings = field(default_factory=NetworkSettings)
    training: TrainingSettings = field(default_factory=TrainingSettings)
    augmentation: AugmentationSettings = field(default_factory=AugmentationSettings)
    calibration: CalibrationSettings = field(default_factory=CalibrationSettings)

    @classmethod
    def from_file(cls, path: Path | str) -> TrainConfig:
        """From a YAML file's sections; `SettingError` names file, line and what would be right."""
        root = read_yaml(path)
        root.allow(*SECTIONS)
        return cls(
            network=root.settings("network", NetworkSettings),
            training=root.settings("training", TrainingSettings),
            augmentation=root.settings("augmentation", AugmentationSettings),
            calibration=root.settings("calibration", CalibrationSettings),
        )

    @classmethod
    def from_plain(cls, sections: dict[str, Any], where: str = "") -> TrainConfig:
        """From the dictionaries that `plain` makes."""
        return cls(**{name: SECTIONS[name].from_mapping(sections[name], where) for name in sections})  # type: ignore[arg-type]

    def changed(self, changes: Iterable[str]) -> TrainConfig:
        """A copy with settings changed by texts of the form section.name=value, as training.batch_size=32."""
        config = self
        for change in changes:
            name, value = name_and_value(change, "training.batch_size=32")
            section, _, key = name.partition(".")
            if section not in SECTIONS:
                raise SettingError(f"--set {change}: {unknown_name(section, tuple(SECTIONS))}")
            config = config.replaced(section, **{key: value})
        return config

    def replaced(self, section: str, **values: Any) -> TrainConfig:
        """A copy with some values of one section changed."""
        settings = getattr(self, section).replaced(**values)
        return dataclasses.replace(self, **{section: settings})

    def plain(self) -> dict[str, dict[str, Any]]:
        """The configuration in types that YAML and JSON have."""
        sections = dataclasses.asdict(self)
        return {
            section: {
                name: list(value) if isinstance(value, tuple) else value for name, value in values.items()
            }
            for section, values in sections.items()
        }
