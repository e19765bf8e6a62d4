"""Everything that decides a training run, as in a file of `config/perception/`, and named choices."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tactile_base.config_paths import config_path
from tactile_base.settings import SettingError, SettingGroups, unknown_name
from tactile_base.yaml_file import Section, name_and_value, read_yaml
from tactile_perception.evaluation.calibration import CalibrationSettings
from tactile_perception.training.settings import AugmentationSettings, NetworkSettings, TrainingSettings

ARITHMETICS = ("fp32", "int8")
_EXTENDS = "extends"
_PROFILES = "perception/profiles.yaml"


@dataclass(frozen=True)
class TrainConfig(SettingGroups):
    """The sections of a training file; the defaults are the paper's GDN."""

    network: NetworkSettings = field(default_factory=NetworkSettings)
    training: TrainingSettings = field(default_factory=TrainingSettings)
    augmentation: AugmentationSettings = field(default_factory=AugmentationSettings)
    calibration: CalibrationSettings = field(default_factory=CalibrationSettings)

    @classmethod
    def from_file(cls, path: Path | str) -> TrainConfig:
        """From a YAML file's sections; `SettingError` names file, line and what would be right.

        What a file does not say is as in the file that it `extends` (beside it, else of this package), and
        the paper's where it extends none.
        """
        return cls._from_files(Path(path), ())

    @classmethod
    def _from_files(cls, path: Path, extending: tuple[Path, ...]) -> TrainConfig:
        root = read_yaml(path)
        root.allow(_EXTENDS, *cls.group_names())
        base = cls()
        if _EXTENDS in root.values:
            other = _training_file(root, path.parent)
            if other in (path, *extending):
                root.fail(f"{_EXTENDS}: {other.name} extends this file", _EXTENDS)
            base = cls._from_files(other, (path, *extending))
        sections: dict[str, Any] = {}
        for name in cls.group_names():
            section, group = root.section(name), base.group(name)
            sections[name] = section.checked(type(group), {**vars(group), **section.values})
        return cls(**sections)

    def changed(self, changes: Iterable[str]) -> TrainConfig:
        """A copy with settings changed by texts of the form section.name=value, as training.batch_size=32."""
        config = self
        for change in changes:
            name, value = name_and_value(change, "training.batch_size=32")
            section, _, key = name.partition(".")
            config = config.merged({section: {key: value}}, f"--set {change}")
        return config

    def plain(self) -> dict[str, dict[str, Any]]:
        """The configuration in types that YAML and JSON have."""
        sections = dataclasses.asdict(self)
        return {
            section: {
                name: list(value) if isinstance(value, tuple) else value for name, value in values.items()
            }
            for section, values in sections.items()
        }


def _training_file(root: Section, folder: Path) -> Path:
    """The file that another one extends."""
    beside = folder / root.text(_EXTENDS)
    if beside.is_file():
        return beside
    try:
        return config_path(f"perception/{root.text(_EXTENDS)}")
    except FileNotFoundError as error:
        root.fail(f"{_EXTENDS}: {error}", _EXTENDS)


@dataclass(frozen=True)
class Profile:
    """How to train a network for a purpose, and how to run it.

    Attributes
    ----------
    use : what it is for
    config : training file
    network : network settings that differ from that file's
    arithmetic : fp32, or int8 for a network that is quantized after training
    threads : CPU threads of the estimator
    """

    name: str
    use: str
    config: Path
    network: dict[str, Any] = field(default_factory=dict)
    arithmetic: str = "fp32"
    threads: int = 1

    @property
    def quantized(self) -> bool:
        """Whether the trained network is then written in 8-bit integers."""
        return self.arithmetic == "int8"


def profiles() -> dict[str, Profile]:
    """All profiles by name; `SettingError` names file, line and what would be right."""
    return read_profiles(config_path(_PROFILES))


def read_profiles(path: Path | str) -> dict[str, Profile]:
    """The profiles of a file."""
    root = read_yaml(path)
    return {name: _profile(name, root.section(name)) for name in root.values}


def profile(name: str) -> Profile:
    """One profile; `SettingError` with the names there are if there is none of this name."""
    found = profiles()
    if name not in found:
        raise SettingError(f"profile: {unknown_name(name, tuple(found))}")
    return found[name]


def _profile(name: str, section: Section) -> Profile:
    section.allow("use", "config", "network", "arithmetic", "threads")
    threads = section.number("threads", 1)
    if threads < 1 or threads != int(threads):
        section.fail(f"{name}.threads = {threads:g}: must be a whole number from 1 on", "threads")
    try:
        config = config_path(f"perception/{section.text('config')}")
    except FileNotFoundError as error:
        section.fail(str(error), "config")
    return Profile(
        name=name,
        use=section.text("use"),
        config=config,
        network=dict(section.section("network").values),
        arithmetic=section.choice("arithmetic", ARITHMETICS, "fp32"),
        threads=int(threads),
    )
