"""RunLog: collects what happens to one arm, row by row, and makes a `RunRecord` of it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_control.phases import Command
from tactile_filter.belief import Belief, BeliefFlag
from tactile_filter.force import ForceGaussian
from tactile_perception.estimating.perceive import Percept
from tactile_records.runs.metrics import COMMAND_STAGE
from tactile_records.runs.record import Event, RunRecord, Series, StageSeries
from tactile_scene.arm import ArmState
from tactile_sim.frame import Frame

Array = NDArray[Any]
S = TypeVar("S", bound=Series)

_FUSED = int(BeliefFlag.MEASUREMENT_FUSED)


class RunLog:
    """The rows of each stream of a record that is being made.

    The record comes with what is known beforehand; `finish` fills in the rest.
    """

    def __init__(self, record: RunRecord) -> None:
        self.record = record
        self._rows: defaultdict[str, list[tuple[Any, ...]]] = defaultdict(list)  # by the record's stream
        self._latency: list[tuple[int, float]] = []

    def state(self, state: ArmState) -> None:
        """What the arm reports."""
        self._rows["pose"].append((state.stamp_ns, state.T_base_controlled))
        self._rows["arm_twist"].append((state.stamp_ns, state.twist))

    def exposure(self, frame: Frame) -> None:
        """An exposure, and what the simulation knows of it."""
        truth = frame.truth
        self._rows["truth"].append((frame.stamp_ns, truth.T_fs, truth.slip_fraction, truth.in_contact))

    def body(self, stamp_ns: int, T_world_body: Array) -> None:
        """Where the simulation has the body that the arm touches and a motion model moves."""
        self._rows["body"].append((stamp_ns, T_world_body))

    def percept(self, stamp_ns: int, percept: Percept) -> None:
        """What perception says of an exposure."""
        row = (stamp_ns, percept.score, bool(percept.in_contact), percept.novelty)
        self._rows["presence"].append(row)
        if percept.in_contact and percept.estimate is not None:
            self._rows["estimate"].append((stamp_ns, percept.estimate.mean, percept.estimate.cov))

    def belief(self, belief: Belief) -> None:
        """What the filter believes."""
        fused = bool(int(belief.flags) & _FUSED)
        row = (belief.stamp_ns, belief.mean, belief.cov, belief.nis, belief.nis_dof, fused)
        self._rows["belief"].append(row)

    def force(self, stamp_ns: int, estimate: ForceGaussian, belief: ForceGaussian, nis: float) -> None:
        """What the network says of the force, and what the filter believes of it."""
        self._rows["force_estimate"].append((stamp_ns, estimate.mean, estimate.cov, np.nan))
        self._rows["force"].append((stamp_ns, belief.mean, belief.cov, nis))

    def command(self, now_ns: int, goal: int, command: Command) -> None:
        """What the controller sends; `goal` is the index of the goal under way."""
        row = (command.twist, command.unlimited, command.error, command.feedforward, command.reference)
        self._rows["command"].append((now_ns, *row, command.phase, goal, command.exposure_ns))

    def ahead(self, now_ns: int, ahead: Callable[[], Sequence[Array]]) -> None:
        """Where the task leads: poses (4, 4) in the base; a record does not keep it."""

    def latency(self, exposure_ns: int, now_ns: int) -> None:
        """When the controller answered an exposure."""
        self._latency.append((exposure_ns, (now_ns - exposure_ns) / SECOND_NS))

    def finish(
        self,
        succeeded: bool,
        reason: str,
        wall_s: float,
        refused: Mapping[str, int] | None = None,
        traceback: str = "",
    ) -> RunRecord:
        """The record with all rows; `refused` counts what perception refused, `traceback` is an error's."""
        record = self.record
        for stream, rows in self._rows.items():
            setattr(record, stream, _series(type(getattr(record, stream)), rows))
        if self._latency:
            record.latency = {COMMAND_STAGE: _series(StageSeries, self._latency)}
        record.events = _phases(record)
        record.result = {"succeeded": succeeded, "reason": reason, "wall_s": wall_s}
        record.result |= {"refused": dict(refused)} if refused else {}
        record.result |= {"traceback": traceback} if traceback else {}
        return record


def _phases(record: RunRecord) -> list[Event]:
    """The phases of the task, as a recording of nodes tells them."""
    phase = record.command.phase
    begins = np.flatnonzero(np.append(np.ones(min(1, len(phase)), bool), phase[1:] != phase[:-1]))
    return [Event(int(record.command.stamp_ns[k]), "phase", f"{record.arm}: {phase[k]}") for k in begins]


def _series(kind: type[S], rows: list[Any]) -> S:
    return kind(*(np.array(column) for column in zip(*rows, strict=True)))
