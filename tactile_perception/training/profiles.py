"""Profiles: named choices between speed and accuracy, in `config/perception/profiles.yaml`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tactile_base.config_paths import config_path
from tactile_base.settings import SettingError, unknown_name
from tactile_base.yaml_file import Section, read_yaml

ARITHMETICS = ("fp32", "int8")
_FILE = "perception/profiles.yaml"


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
    return read_profiles(config_path(_FILE))


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
