"""Runs the events of a bag through the filter, as the live node does, and encodes what it would publish.

The same bag, settings and program give the same bytes, however often and on however many cores.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_base.topics import BELIEF, FORCE_BELIEF, STATE
from tactile_filter.bayes_filter import Belief, BeliefFlag, ContactFilter, FilterSettings
from tactile_filter.force import ForceFilter, ForceGaussian
from tactile_filter.smoother import smooth
from tactile_geometry.gaussian import UNUSABLE, ros_from_left
from tactile_records.bags.message_columns import stamps_ns
from tactile_records.replay.settings import Change
from tactile_records.replay.topics import POSE
from tactile_records.replay.track import ArmInputs, LiveStates, Measurement
from tactile_records.runs.record import BeliefSeries
from tactile_wire.cdr import Layout, blank_layout
from tactile_wire.pose_numbers import numbers_from_pose

Array = NDArray[Any]

NOT_COMPARED = ("latency.sec", "latency.nanosec", "novelty")  # of machine and images, not of the filter
_OF_BELIEFS = sum(BeliefFlag)


@dataclass
class ArmRun:
    """One arm's run of the filter.

    Attributes
    ----------
    measurements : list of Measurement
        Those that were taken; `beliefs` has one for each, `smoothed` as well after `smooth_run`.
    forces : list
        What is believed of the force: (stamp, Gaussian, NIS), and when its measurement was recorded.
    states : ndarray
        The ContactState messages, as structured array.
    left_out : int
        Events that are no part of what the live filter took.
    resets, rejections : Counter
        Of the filter over the whole run, by reason.
    """

    inputs: ArmInputs
    settings: FilterSettings
    measurements: list[Measurement] = field(default_factory=list)
    beliefs: list[Belief] = field(default_factory=list)
    smoothed: list[Belief] = field(default_factory=list)
    forces: list[tuple[tuple[int, ForceGaussian, float], int]] = field(default_factory=list)
    states: Array = field(default_factory=lambda: np.zeros(0))
    left_out: int = 0
    resets: Counter[str] = field(default_factory=Counter)
    rejections: Counter[str] = field(default_factory=Counter)


def series_of(beliefs: Sequence[Belief]) -> BeliefSeries:
    """The beliefs that are valid, as arrays."""
    valid = [belief for belief in beliefs if belief.valid]
    refused = BeliefFlag.GATED | BeliefFlag.PREDICTED_ONLY
    if not valid:
        return BeliefSeries()
    return BeliefSeries(
        np.array([belief.stamp_ns for belief in valid]),
        np.array([belief.mean for belief in valid]),
        np.array([belief.cov for belief in valid]),
        np.array([belief.nis for belief in valid]),
        np.array([belief.nis_dof for belief in valid]),
        np.array([not belief.flags & refused for belief in valid]),
    )


def run_filter(
    inputs: ArmInputs, settings: FilterSettings, as_recorded: bool = True, changes: Sequence[Change] = ()
) -> ArmRun:
    """Run one arm's events through the filter.

    Parameters
    ----------
    changes : sequence of Change
        Settings that change on the way.
    as_recorded : bool
        Take the events that the live filter took, where the bag shows which these were; else all that there
        are. The live filter drops an event whose parts come too late, and takes none before it is active.
    """
    run = ArmRun(inputs, settings)
    taken = _taken_live(inputs) if as_recorded else None
    contact_filter, epoch = ContactFilter(settings, inputs.bounds), 0
    force_filter = ForceFilter(inputs.force_settings)
    waiting, taken_at = list(changes), _times_taken(inputs) if changes else {}
    for measurement in inputs.measurements:
        if taken is not None and not taken(measurement.stamp_ns):
            run.left_out += 1
            continue
        if measurement.epoch != epoch:
            epoch = measurement.epoch
            contact_filter.reset("time jumped back")
        if as_recorded and measurement.stamp_ns in inputs.resets:
            contact_filter.reset("service")
        now_ns = taken_at.get(measurement.stamp_ns, measurement.received_ns)
        while waiting and waiting[0].stamp_ns < now_ns:
            contact_filter.configure(contact_filter.settings.replaced(**waiting.pop(0).values))
        run.measurements.append(measurement)
        belief = contact_filter.observe(measurement.stamp_ns, measurement.estimate, measurement.T_base_sensor)
        run.beliefs.append(belief)
        if measurement.estimate is None:
            force_filter.reset()
        elif measurement.force is not None and not force_filter.step(measurement.stamp_ns, measurement.force):
            assert force_filter.belief is not None
            told = measurement.stamp_ns, force_filter.belief, force_filter.nis
            run.forces.append((told, measurement.received_ns))
    run.rejections, run.resets = contact_filter.all_rejections, contact_filter.resets
    run.states = state_rows(run.beliefs, inputs.sensor_frame)
    return run


def smooth_run(run: ArmRun) -> None:
    """Add what each belief would have been if all that came later had been known."""
    poses = [UNUSABLE.mean if m.T_base_sensor is None else m.T_base_sensor for m in run.measurements]
    run.smoothed = smooth(run.beliefs, poses, run.settings)


def _taken_live(inputs: ArmInputs) -> Any:
    """Whether the live filter took the event of a stamp; all count as taken after its last message.

    None where the bag does not show it.
    """
    if inputs.live is None or not len(inputs.live.stamps_ns):
        return None
    stamps, last = set(inputs.live.stamps_ns.tolist()), int(inputs.live.stamps_ns.max())
    return lambda stamp_ns: stamp_ns in stamps or stamp_ns > last


def _times_taken(inputs: ArmInputs) -> dict[int, int]:
    """Stamp -> when the live filter had made its belief of it, ns: the node did one thing at a time."""
    if inputs.live is None:
        return {}
    latency = stamps_ns(inputs.live.values, "latency")
    return dict(zip(inputs.live.stamps_ns.tolist(), (inputs.live.stamps_ns + latency).tolist(), strict=True))


# ---- messages ----


def state_rows(beliefs: Sequence[Belief], sensor_frame: str) -> Array:
    """The ContactState messages of beliefs, as structured array; their latency is 0."""
    rows = _blank(_layout(STATE.type, sensor_frame), len(beliefs))
    if not len(rows):
        return rows
    _set_stamps(rows, [belief.stamp_ns for belief in beliefs])
    vectors = [belief.vectors() for belief in beliefs]
    rows["xi"], rows["euler"] = [xi for xi, _ in vectors], [euler for _, euler in vectors]
    rows["covariance"] = np.array([belief.cov for belief in beliefs]).reshape(-1, 36)
    rows["nis"] = [belief.nis for belief in beliefs]
    rows["nis_dof"] = [belief.nis_dof for belief in beliefs]
    rows["flags"] = [int(belief.flags) for belief in beliefs]
    rows["rejected"] = [belief.rejected for belief in beliefs]
    rows["inflation"] = [belief.inflation for belief in beliefs]
    rows["novelty"] = np.nan  # of images, which a filter does not see
    return rows


def pose_rows(gaussians: Sequence[tuple[int, Array, Array]], frame_id: str) -> Array:
    """PoseWithCovarianceStamped messages of Gaussians (stamp, mean, left covariance), as structured array."""
    rows = _blank(_layout(BELIEF.type, frame_id), len(gaussians))
    if not len(rows):
        return rows
    _set_stamps(rows, [stamp_ns for stamp_ns, _, _ in gaussians])
    means = np.array([mean for _, mean, _ in gaussians])
    for name, values in zip(POSE, numbers_from_pose(means).T, strict=True):
        rows[name] = values
    covs = ros_from_left(np.array([cov for _, _, cov in gaussians]), means[:, :3, 3])
    rows["pose.covariance"] = covs.reshape(-1, 36)
    return rows


def force_rows(forces: Sequence[tuple[int, ForceGaussian, float]], frame_id: str) -> Array:
    """ContactForce messages of forces (stamp, Gaussian, NIS), as structured array."""
    rows = _blank(_layout(FORCE_BELIEF.type, frame_id), len(forces))
    if not len(rows):
        return rows
    _set_stamps(rows, [stamp_ns for stamp_ns, _, _ in forces])
    rows["force"] = [force.mean for _, force, _ in forces]
    rows["covariance"] = np.array([force.cov for _, force, _ in forces]).reshape(-1, 9)
    rows["nis"] = [nis for _, _, nis in forces]
    return rows


@functools.lru_cache(maxsize=64)
def _layout(type_name: str, frame_id: str) -> Layout:
    return blank_layout(type_name, {"header.frame_id": frame_id})


def _blank(layout: Layout, count: int) -> Array:
    return np.frombuffer(bytearray(layout.template * count), layout.dtype)


def _set_stamps(rows: Array, stamps: Sequence[int]) -> None:
    seconds, rest = np.divmod(np.array(stamps, np.int64), SECOND_NS)
    rows["header.stamp.sec"], rows["header.stamp.nanosec"] = seconds, rest


# ---- agreement with what was live ----


@dataclass(frozen=True)
class Agreement:
    """How a run compares with what the live filter published.

    Attributes
    ----------
    common : int
        Stamps that both have, with the same history.
    identical : int
        Of these, messages that are the same to the bit (latency and the flag STILL aside).
    only_live, only_replayed : int
        Stamps that only one of them has; of those that only the live filter has, the bag lacks the inputs.
    first_difference : str
        Where they first differ, and in what; empty where they do not.
    after_gap : int
        Stamps that both have, after one that only the live filter has and in the same contact: what that
        one did to the belief is not known.
    before_inputs : int
        Stamps of the live filter from before the bag's first input: topics are not found all at once when a
        recording begins.
    """

    common: int
    identical: int
    only_live: int
    only_replayed: int
    first_difference: str = ""
    after_gap: int = 0
    before_inputs: int = 0


def agreement(rows: Array, live: LiveStates) -> Agreement:
    """Compare `state_rows` with what the live filter published."""
    stamps = stamps_ns(rows, "header.stamp")
    replayed = {int(stamp): row for row, stamp in enumerate(stamps)}
    begun_ns = int(stamps[0]) if len(stamps) else 0
    pairs, only_live, after_gap, before_inputs = [], 0, 0, 0
    gap = False
    for place, (stamp, flags) in enumerate(zip(live.stamps_ns.tolist(), live.values["flags"], strict=True)):
        if stamp not in replayed:
            only_live, before_inputs = only_live + (stamp >= begun_ns), before_inputs + (stamp < begun_ns)
            gap = True
            continue
        gap = gap and not flags & BeliefFlag.NO_CONTACT
        if gap:
            after_gap += 1
        else:
            pairs.append((replayed[stamp], place))
    mine, theirs = (np.array([pair[k] for pair in pairs], np.int64) for k in (0, 1))
    values = live.values.copy()
    values["flags"] &= _OF_BELIEFS  # that images stand still is said there, too
    names = [
        n for n in rows.dtype.names or () if n in (live.values.dtype.names or ()) and n not in NOT_COMPARED
    ]
    same = np.ones(len(pairs), bool)
    differing = np.full(len(pairs), "", object)
    for name in names if pairs else ():
        a = np.ascontiguousarray(rows[name][mine]).reshape(len(pairs), -1).view(np.uint8)
        b = np.ascontiguousarray(values[name][theirs]).reshape(len(pairs), -1).view(np.uint8)
        equal = (a == b).all(axis=1) if a.shape == b.shape else np.zeros(len(pairs), bool)
        differing[same & ~equal] = name
        same &= equal
    first = ""
    if not same.all():
        at = int(np.argmin(same))
        first = f"{differing[at]} at {int(stamps[mine[at]])} ns"
    only_replayed = len(rows) - len(pairs) - after_gap
    return Agreement(len(pairs), int(same.sum()), only_live, only_replayed, first, after_gap, before_inputs)
