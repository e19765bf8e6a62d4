"""File about one object: where the sensors touch it, and how their contacts are fused.

::

    settings: {max_age: 0.05}               # of `TrackerSettings`; what is missing has its default
    places:                                 # what is missing is found by touch
      left: {position: [0.0, 0.03, 0.0], rotation_deg: [90, 0, 0], sigma_position: [2e-3, 2e-3, 0]}
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from tactile_base.settings import unknown_name
from tactile_base.yaml_file import Section, read_yaml
from tactile_filter.object.settings import PlaceSettings, TrackerSettings

_NONE = (0.0, 0.0, 0.0)


def load_object(path: str | Path, arms: Sequence[str]) -> tuple[TrackerSettings, dict[str, PlaceSettings]]:
    """Settings, and the places that are given, by arm.

    Raises
    ------
    SettingError
        With file, line and valid choices; also where a place is that of none of the arms.
    OSError
        Where the file cannot be read.
    """
    root = read_yaml(path)
    root.allow("settings", "places")
    places = {}
    for arm, section in root.sections("places").items():
        if arm not in arms:
            root.section("places").fail(f"places: {unknown_name(arm, list(arms))}", arm)
        places[arm] = _place(section)
    return root.settings("settings", TrackerSettings), places


def _place(section: Section) -> PlaceSettings:
    section.allow("position", "rotation_deg", "sigma_position", "sigma_rotation_deg")
    pose, sigma = (
        (*section.numbers(f"{prefix}position", 3, _NONE), *_radians(section, f"{prefix}rotation_deg"))
        for prefix in ("", "sigma_")
    )
    return section.checked(PlaceSettings, {"given": True, "pose": pose, "sigma": sigma})


def _radians(section: Section, key: str) -> tuple[float, ...]:
    return tuple(map(math.radians, section.numbers(key, 3, _NONE)))
