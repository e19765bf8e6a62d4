"""Settings of the belief over an object: how contacts count, where on the object they are; and their file.

::

    settings: {max_age: 0.05}               # of `TrackerSettings`; what is missing has its default
    places:                                 # what is missing is found by touch
      left: {position: [0.0, 0.03, 0.0], rotation_deg: [90, 0, 0], sigma_position: [2e-3, 2e-3, 0]}
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tactile_base.settings import LARGEST_POSE, SMALLEST_POSE, SettingError, Settings, setting, unknown_name
from tactile_base.yaml_file import Section, read_yaml
from tactile_filter.object.belief import moved_covariance
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian


@dataclass(frozen=True)
class TrackerSettings(Settings):
    """How the contacts of several sensors become one belief over the object, and for how long each counts."""

    correlated_share: float = setting(
        0.0, lower=0.0, upper=1.0,
        doc="share of each contact belief's covariance that others may have in common: 0 where the contacts "
        "err independently, 1 where nothing is known of it",
    )  # fmt: skip
    gate_probability: float = setting(
        0.999999, lower=0.5, upper=1.0,
        doc="a contact is refused if it disagrees with those before it by more than this quantile of "
        "chi-square; 1 refuses none",
    )  # fmt: skip
    max_age: float = setting(
        0.05, lower=0.0, upper=10.0, unit="s",
        doc="a contact whose last belief is older than this, at the stamp of the object's, is left out",
    )  # fmt: skip
    object_speed: float = setting(
        0.02, lower=0.0, upper=1.0, unit="m/s",
        doc="standard deviation of the object's velocity: what a belief of an earlier stamp says less of",
    )  # fmt: skip
    object_turn_rate: float = setting(
        0.2, lower=0.0, upper=10.0, unit="rad/s", doc="standard deviation of the object's angular velocity"
    )
    forget_after: float = setting(
        0.5, lower=0.0, upper=3600.0, unit="s",
        doc="a contact that nothing was heard of for longer has ended, and a place found for it is forgotten",
    )  # fmt: skip
    replace_after: float = setting(
        0.5, lower=0.0, upper=3600.0, unit="s",
        doc="a contact that was refused for longer, because it slid for instance, is given a new place by "
        "what the others know; a place that is given stays",
    )  # fmt: skip
    slide_shear: float = setting(
        0.5, lower=0.0, upper=10.0,
        doc="a contact sheared by clearly more than this part of its depth may slide: it is left out, and "
        "its place is forgotten, a given one too; 0: contacts never slide",
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_age > self.forget_after:
            raise SettingError(
                f"max_age = {self.max_age:g} s: must not be longer than forget_after "
                f"= {self.forget_after:g} s"
            )


@dataclass(frozen=True)
class PlaceSettings(Settings):
    """Where on the object the contact of one sensor is."""

    given: bool = setting(
        False, doc="whether pose says where the contact is on the object; otherwise that is found by touch"
    )
    pose: tuple[float, ...] = setting(
        (0.0,) * 6, length=6, lower=SMALLEST_POSE, upper=LARGEST_POSE, unit="m, rad",
        doc="of the contact's feature frame in the object's: x, y, z, alpha, beta, gamma, extrinsic xyz",
    )  # fmt: skip
    sigma: tuple[float, ...] = setting(
        (0.0,) * 6, length=6, lower=0.0, upper=[1.0] * 3 + [math.pi] * 3, unit="m, rad",
        doc="standard deviations of that along and about the feature frame's own x, y, z",
    )  # fmt: skip

    def place(self) -> PoseGaussian | None:
        """T_object_feature with its covariance; None if it is to be found."""
        if not self.given:
            return None
        mean = se3.pose_from_euler(np.array(self.pose))
        return PoseGaussian(mean, moved_covariance(mean, np.diag(np.square(self.sigma))))


_NONE = (0.0, 0.0, 0.0)


def load_object(path: str | Path, arms: Sequence[str]) -> tuple[TrackerSettings, dict[str, PlaceSettings]]:
    """Settings, and the places that are given, by arm.

    `SettingError` names file, line and valid choices, also where a place is that of none of the arms;
    `OSError` where the file cannot be read.
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
