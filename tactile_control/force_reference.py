"""Contacts that press with a reference force: the reference depth at which they do, found while in contact.

A task in contact is servoed to a depth. Where the network tells the force, that depth can follow from a
normal force in its place: the skin's own stiffness, believed force over believed depth, says by how much the
depth is wrong, and the reference goes there at a rate. What limits and checks depths goes on doing so, and a
force that does not come stops the arm like any input that it needs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings, setting
from tactile_base.stamps import NANOSECOND

Array = NDArray[np.float64]
_RATIO, _LONGEST = 2.0, 0.1  # a force is taken for no further off than by this factor; s between two beliefs
_TINY = 1e-9
_POWER = 1.6  # of the depth, with which a skin's force grows: Hertz 1.5, a real pad 1.75


@dataclass(frozen=True)
class StampedForce:
    """A force (3,) on the sensor, N, in {s}: believed at an exposure's stamp, or measured."""

    stamp_ns: int
    force: Array


@dataclass(frozen=True)
class ForceControlSettings(Settings):
    """The force of a contact; forces are told by networks of the model `surface_force` alone."""

    normal: float = setting(
        0.0, lower=0.0, upper=100.0, unit="N",
        doc="reference normal force of a task's own phases, in place of the depth in servoing.reference, "
        "with which it begins; 0: that depth holds",
    )  # fmt: skip
    rate: float = setting(
        2.5, lower=0.01, upper=20.0, unit="1/s", doc="at which a depth that gives another force is corrected"
    )
    least_depth: float = setting(
        0.0008, lower=0.0, upper=0.01, unit="m", doc="least reference depth for the sake of a force"
    )
    most_depth: float = setting(0.006, lower=0.0, upper=0.01, unit="m", doc="and the largest")
    most: float = setting(
        0.0, lower=0.0, upper=1000.0, unit="N",
        doc="a contact that presses with more fails the task; 0: any",
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.most_depth <= self.least_depth:
            raise SettingError(
                f"most_depth: must be more than least_depth ({self.least_depth:g} m), is {self.most_depth:g}"
            )
        if 0.0 < self.most <= self.normal:
            raise SettingError(f"most: must be 0 or more than normal ({self.normal:g} N), is {self.most:g}")

    @property
    def needed(self) -> bool:
        """Whether a contact needs to know its force."""
        return self.normal > 0.0 or self.most > 0.0


class ForceReference:
    """The reference depth for a normal force; see the module's text.

    Attributes
    ----------
    depth : float or None
        m; None before the first step.
    """

    def __init__(self, settings: ForceControlSettings) -> None:
        self.settings = settings
        self.reset()

    def reset(self) -> None:
        """Begin anew, as with another contact."""
        self.depth: float | None = None
        self._stamp_ns = 0

    def step(self, stamp_ns: int, start: float, depth: float, force: float, hold: bool = False) -> float:
        """The reference depth (m) after a belief of a stamp: `depth` (m) and normal `force` (N).

        `start` is the depth that it begins at. With `hold` it stays: the arm does not follow as it is.
        """
        settings = self.settings
        if self.depth is None:
            self.depth, self._stamp_ns = start, stamp_ns
        seconds = min(max(0.0, (stamp_ns - self._stamp_ns) * NANOSECOND), _LONGEST)
        self._stamp_ns = max(stamp_ns, self._stamp_ns)
        if not hold:
            ratio = min(max(settings.normal / max(force, _TINY), 1.0 / _RATIO), _RATIO)
            off = (ratio ** (1.0 / _POWER) - 1.0) * max(depth, settings.least_depth)
            self.depth += (1.0 - math.exp(-settings.rate * seconds)) * off
        self.depth = min(max(self.depth, settings.least_depth), settings.most_depth)
        return self.depth


def normal_force(force: Array, X_sf: Array) -> float:
    """How much (N) a force (3,) on the sensor presses along the normal of the contact X_sf (4, 4).

    A contact does not pull: whichever sign the labels of a network had, it is the size that counts.
    """
    return abs(float(X_sf[:3, 2] @ force))
