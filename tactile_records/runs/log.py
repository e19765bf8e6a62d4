"""RunLog: collects what happens to one arm, row by row, and makes a `RunRecord` of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_control.phases import Command, StampedPose
from tactile_drivers.sim.cell import Truth
from tactile_filter.belief import Belief, BeliefFlag
from tactile_perception.estimating.perceive import Percept
from tactile_records.runs.record import (
    ArmSeries,
    BeliefSeries,
    CommandSeries,
    GaussianSeries,
    PoseSeries,
    PresenceSeries,
    RunRecord,
    StageSeries,
    TruthSeries,
)

Array = NDArray[Any]

CONTROLLER = "controller"  # the stage whose latency is that from the exposure to the command
_STREAMS = ("pose", "arm", "truth", "presence", "estimate", "belief", "command", "latency")


class RunLog:
    """The rows of each stream of a record that is being made.

    Parameters
    ----------
    record : RunRecord
        With what is known beforehand; `finish` fills in the rest.
    """

    def __init__(self, record: RunRecord) -> None:
        self.record = record
        self._rows: dict[str, list[tuple[Any, ...]]] = {name: [] for name in _STREAMS}

    def pose(self, pose: StampedPose, twist: Array) -> None:
        """What the arm reports."""
        self._rows["pose"].append((pose.stamp_ns, pose.T))
        self._rows["arm"].append((pose.stamp_ns, twist))

    def truth(self, stamp_ns: int, truth: Truth) -> None:
        """What the simulation knows of an exposure."""
        self._rows["truth"].append((stamp_ns, truth.T_fs, truth.slip_fraction, truth.in_contact))

    def percept(self, stamp_ns: int, percept: Percept) -> None:
        """What perception says of an exposure."""
        self._rows["presence"].append((stamp_ns, percept.score, bool(percept.in_contact)))
        if percept.in_contact and percept.estimate is not None:
            self._rows["estimate"].append((stamp_ns, percept.estimate.mean, percept.estimate.cov))

    def belief(self, belief: Belief) -> None:
        """What the filter believes."""
        fused = bool(belief.flags & BeliefFlag.MEASUREMENT_FUSED)
        row = (belief.stamp_ns, belief.mean, belief.cov, belief.nis, belief.nis_dof, fused)
        self._rows["belief"].append(row)

    def command(self, now_ns: int, goal: int, command: Command) -> None:
        """What the controller sends; `goal` is the index of the goal under way."""
        row = (command.twist, command.unlimited, command.error, command.feedforward, command.reference)
        self._rows["command"].append((now_ns, *row, command.phase, goal, command.exposure_ns))

    def latency(self, exposure_ns: int, now_ns: int) -> None:
        """When the controller answered an exposure."""
        self._rows["latency"].append((exposure_ns, (now_ns - exposure_ns) / SECOND_NS))

    def finish(self, succeeded: bool, reason: str, wall_s: float) -> RunRecord:
        """The record with all rows."""
        record = self.record
        record.pose = PoseSeries(*self._columns("pose"))
        record.arm_twist = ArmSeries(*self._columns("arm"))
        record.truth = TruthSeries(*self._columns("truth"))
        record.presence = PresenceSeries(*self._columns("presence"))
        record.estimate = GaussianSeries(*self._columns("estimate"))
        record.belief = BeliefSeries(*self._columns("belief"))
        record.command = CommandSeries(*self._columns("command"))
        if self._rows["latency"]:
            record.latency = {CONTROLLER: StageSeries(*self._columns("latency"))}
            record.lost = {CONTROLLER: 0}
        record.result = {"succeeded": succeeded, "reason": reason, "wall_s": wall_s}
        return record

    def _columns(self, stream: str) -> list[Array]:
        return [np.array(column) for column in zip(*self._rows[stream], strict=True)]
