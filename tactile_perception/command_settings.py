"""Settings changed on the command line: texts of the form NAME=VALUE."""

from __future__ import annotations

from typing import Any

import yaml

from tactile_filter.settings import SettingError


def name_and_value(change: str, example: str) -> tuple[str, Any]:
    """Split NAME=VALUE; the value is read as YAML, and 1e-3 as the number that it is.

    Raises
    ------
    SettingError
        If there is no "=", or the value is no YAML.
    """
    name, equals, text = change.partition("=")
    if not equals:
        raise SettingError(f"--set {change}: must have the form NAME=VALUE, as {example}")
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise SettingError(f"--set {change}: the value cannot be read: {error}") from error
    return name, _numbers(value)


def _numbers(value: Any) -> Any:
    """YAML 1.1 takes 1e-3 for text."""
    if isinstance(value, list):
        return [_numbers(element) for element in value]
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value
