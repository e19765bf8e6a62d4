"""How closely a follower kept to what a leader moved: errors by component, and the lag behind it."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_geometry import se3
from tactile_records.runs.record import PoseSeries, RunRecord

Array = NDArray[Any]

LONGEST_LAG = 1.0  # s
STEP = 0.01  # s; at which velocities are compared


@dataclass(frozen=True)
class Tracking:
    """A follower and its leader at the same stamps, while the leader moves and the follower tracks.

    Attributes
    ----------
    stamp_ns : ndarray (N,)
    T_world_leader, T_world_follower : ndarray (N, 4, 4) their controlled frames
    T_world_target : ndarray (N, 4, 4)
        Where the follower would be had it kept, to the leader, the pose that it began with.
    goal : ndarray (N,) index of the leader's goal
    goals : names of the leader's goals
    """

    stamp_ns: Array
    T_world_leader: Array
    T_world_follower: Array
    T_world_target: Array
    goal: Array
    goals: list[str]

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def error(self) -> Array:
        """log(T_target^-1 T_follower) (N, 6): m and rad, in the frame in which the follower should be."""
        pairs = zip(self.T_world_target, self.T_world_follower, strict=True)
        return np.array([se3.log(se3.inverse(a) @ b) for a, b in pairs]).reshape(-1, 6)

    def lag(self) -> tuple[float, float]:
        """Seconds by which the follower's velocity and angular velocity are behind; NaN for none to compare.

        The delay at which the correlation with the velocity of the target is largest, by a parabola through
        the three points about it.
        """
        if not len(self) or self.stamp_ns[-1] - self.stamp_ns[0] < 4.0 * LONGEST_LAG * SECOND_NS:
            return np.nan, np.nan
        wanted, made = (_velocities(self.stamp_ns, T) for T in (self.T_world_target, self.T_world_follower))
        return _delay(wanted[:, :3], made[:, :3]), _delay(wanted[:, 3:], made[:, 3:])


def leader_of(record: RunRecord, run: Mapping[str, RunRecord]) -> RunRecord | None:
    """The arm that moves what this one tracks: the other one that follows a trajectory, if there is one."""
    others = [other for name, other in run.items() if name != record.arm and other.task == "trajectory"]
    return others[0] if len(others) == 1 else None


def tracking(follower: RunRecord, leader: RunRecord) -> Tracking:
    """The stretch of a run in which the leader moves and the follower tracks."""
    stamps = follower.pose.stamp_ns
    moving = leader.working(stamps) & follower.working(stamps)
    if len(leader.pose):
        moving &= (stamps >= leader.pose.stamp_ns[0]) & (stamps <= leader.pose.stamp_ns[-1])
    stamps = stamps[moving]
    T_follower = follower.T_world_base @ follower.pose.T_base_sensor[moving]
    T_leader = leader.T_world_base @ leader.pose.at(stamps)
    kept = se3.inverse(T_leader[0]) @ T_follower[0] if len(stamps) else np.eye(4)
    return Tracking(stamps, T_leader, T_follower, T_leader @ kept, leader.goal_at(stamps), leader.goals)


def _velocities(stamp_ns: Array, T: Array) -> Array:
    """Velocity of the origin and angular velocity (M, 6), along fixed axes, every `STEP` s."""
    even = np.arange(stamp_ns[0], stamp_ns[-1], round(STEP * SECOND_NS))
    velocities = []
    for a, b in itertools.pairwise(PoseSeries(stamp_ns, T).at(even)):
        turn = se3.log(se3.inverse(a) @ b)[3:]
        velocities.append(np.concatenate([b[:3, 3] - a[:3, 3], a[:3, :3] @ turn]) / STEP)
    return np.array(velocities)


def _delay(wanted: Array, made: Array) -> float:
    """Seconds by which `made` (M, 3) follows `wanted` (M, 3); NaN where nothing moves."""
    if np.linalg.norm(wanted, axis=1).max() < 1e-4:
        return float("nan")
    most = round(LONGEST_LAG / STEP)
    count = len(wanted) - most
    windows = [made[k : k + count] for k in range(most + 1)]
    match = np.array([np.sum(wanted[:count] * window) / np.linalg.norm(window) for window in windows])
    best = int(np.argmax(match))
    if 0 < best < most:
        before, at, after = match[best - 1 : best + 2]
        return float(best + 0.5 * (before - after) / (before - 2.0 * at + after)) * STEP
    return best * STEP
