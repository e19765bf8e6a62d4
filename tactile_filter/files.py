"""The filter's configuration file."""

from __future__ import annotations

from pathlib import Path

from tactile_base.config_paths import config_path
from tactile_base.yaml_file import read_yaml
from tactile_filter.bayes_filter import FilterSettings


def load_filter_settings(path: str | Path | None = None) -> FilterSettings:
    """Settings from a file, by default `config/filter.yaml`.

    Raises
    ------
    SettingError
        With file, line and valid choices.
    OSError
        Where the file cannot be read.
    """
    section = read_yaml(path if path is not None else config_path("filter.yaml"))
    return section.checked(FilterSettings, section.values)
