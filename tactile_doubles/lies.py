"""Lies: what in a simulated run does not tell the truth, and a witness who does.

A lie stands between the simulated cell and what believes it. Everything else of the run is as ever, so what a
lie leads to is held against the cell's own truth::

    class Mirrored(Lies):
        def image(self, arm, stamp_ns, image):
            return image[:, ::-1] if self.begun(stamp_ns) else image

    lies = Mirrored(begins=4.0)
    run_arms_offline("plane", options=OfflineOptions(lies=lies))
    lies.witness["arm"].deepest                          # m, of the true tip below the true surface
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_geometry import se3

if TYPE_CHECKING:
    from tactile_geometry.gaussian import PoseGaussian
    from tactile_sim.arm import SimArm
    from tactile_sim.cell import Cell

Array = NDArray[np.float64]

AT_REST = 1e-4  # m/s


@dataclass
class Witness:
    """What was true of one arm since the lie began.

    Attributes
    ----------
    deepest : float
        Of the undeformed tip below the nearest surface, m; -inf if it never came near to one.
    fastest : float
        Largest speed of the controlled frame, m/s.
    way : float
        Length of its path, m.
    rests_since : float
        From then on the arm was at rest to the end, s after the lie began; inf: it never was.
    position : ndarray (3,)
        Where the controlled frame stands in the arm's base, m; NaN before anything was seen.
    """

    deepest: float = -math.inf
    fastest: float = 0.0
    way: float = 0.0
    rests_since: float = 0.0
    position: Array = field(default_factory=lambda: np.full(3, np.nan))

    def see(self, since: float, T_base_controlled: Array, speed: float, depth: float) -> None:
        """Take one step: seconds since the lie began, true pose (4, 4), speed (m/s), depth (m)."""
        position = T_base_controlled[:3, 3]
        self.way += float(np.nan_to_num(se3.norm(position - self.position)))
        self.position = position.copy()
        self.fastest = max(self.fastest, speed)
        self.deepest = max(self.deepest, depth)
        if speed > AT_REST:
            self.rests_since = math.inf
        elif math.isinf(self.rests_since):
            self.rests_since = since


class Lies:
    """None: everything is passed on as it is. A lie overrides what it changes, for the time since it began.

    Parameters
    ----------
    begins : float
        When it begins, s of the cell's time.
    arm : str
        Whom it is about; empty: all.

    Attributes
    ----------
    aftermath : float
        How long it is seen what comes of it after the run, s.
    witness : mapping of str to Witness
        By arm, of those with a sensor that the cell simulates; the depth where there is something to touch.
    """

    aftermath = 2.0

    def __init__(self, begins: float = 0.0, arm: str = "") -> None:
        self.begins_ns, self.about = round(begins * SECOND_NS), arm
        self.witness: dict[str, Witness] = defaultdict(Witness)

    def begun(self, stamp_ns: int, arm: str = "") -> bool:
        """Whether it holds at a stamp (ns), for an arm."""
        return stamp_ns >= self.begins_ns and (not self.about or not arm or arm == self.about)

    def driver(self, name: str, arm: SimArm) -> Any:
        """Who drives an arm (`Arm`), and tells its `state`."""
        return arm

    def image(self, name: str, stamp_ns: int, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """What the camera of an arm's sensor gives for what it exposed."""
        return image

    def estimate(self, name: str, stamp_ns: int, estimate: PoseGaussian | None) -> PoseGaussian | None:
        """What perception says of the contact, X_sf, where it would have said this."""
        return estimate

    def see(self, cell: Cell) -> None:
        """Take what is true after a step of the cell."""
        if cell.stamp_ns < self.begins_ns:
            return
        since = (cell.stamp_ns - self.begins_ns) / SECOND_NS
        for name in cell.arms:
            speed = se3.norm(cell.arm(name).twist[:3])
            self.witness[name].see(since, cell.T_base_sensor(name), speed, cell.depth(name))
